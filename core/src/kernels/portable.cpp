// For every machine: 128-bit vectors as GCC and Clang translate them to what the target has.
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

struct Portable : ByPairs<Portable, 16> {
  using Sums16 = Pack<Shorts, 4>;
  static Sums16 widen(const int8_t* weights) {
    Sums16 result;
    for (int i = 0; i < 4; i += 2) {
      // Two vectors at a time, which is two instructions.
      const auto both =
          __builtin_convertvector(load<Vector<int8_t, 16>>(weights + 8 * i), Vector<int16_t, 32>);
      store(&result.v[i], both);
    }
    return result;
  }
  // The products of bytes fit 16 bits.
  static Ints multiply_pairs(Shorts a, Shorts b) {
    const auto products = (Ints)(a * b);
    return (products << 16 >> 16) + (products >> 16);
  }
  using Step = uint8_t[4];
  static constexpr int kDenseBatch = 1;
  static constexpr int kDenseGroups = 1;
  // For shifts of any size. s * multiplier is below 2^62, so adding 2^61 at most cannot overflow.
  template <typename Sum>
  static void activate(const Activation& a, const Sum* sums, size_t n, uint8_t* next,
                       size_t stride) {
    const int64_t half = int64_t{1} << (a.shift - 1);
    for (size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
      for (size_t o = 0; o < kOutputs; ++o) {
        const int64_t s = int64_t{sums[o]} + a.bias[o];
        const int64_t t = (s * a.multipliers[o] + half) >> a.shift;
        next[o] = a.table[t < -128 ? 0 : t > 127 ? 255 : t + 128];
      }
    }
  }

  static constexpr size_t kBlocks = 1;
  using Flags = Ints;
  static Flags above(const Sums& sums, int32_t threshold) {
    return (sums.v[0] > threshold) | (sums.v[1] > threshold) | (sums.v[2] > threshold) |
           (sums.v[3] > threshold);
  }
  static bool any(Flags flags) {
    const auto halves = (Vector<uint64_t, 16>)flags;
    return (halves[0] | halves[1]) != 0;
  }
  static unsigned near_rows(const Sums& sums, int32_t threshold) {
    unsigned bits = 0;
    for (unsigned r = 0; r < kCodeRows; ++r) {
      bits |= (sums.v[r / 4][r % 4] > threshold ? 1u : 0u) << r;
    }
    return bits;
  }

  static constexpr int kWordQueries = 1;
  using Words = Pack<Vector<uint64_t, 16>, 4>;
  static void add_bits(Words& counts, uint64_t query, const Words& row) {
    for (int i = 0; i < 4; ++i) {
      // No std::popcount: without -mpopcnt it is a library call, and not of vectors.
      auto x = row.v[i] ^ query;
      x -= (x >> 1) & 0x5555555555555555u;
      x = (x & 0x3333333333333333u) + ((x >> 2) & 0x3333333333333333u);
      x = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0fu;
      x += x >> 8;
      x += x >> 16;
      x += x >> 32;
      counts.v[i] += x & 0xff;
    }
  }
  static unsigned near_words(const Words& counts, int32_t limit) {
    unsigned bits = 0;
    for (unsigned r = 0; r < kWordRows; ++r) {
      bits |= (static_cast<int32_t>(counts.v[r / 2][r % 2]) <= limit ? 1u : 0u) << r;
    }
    return bits;
  }
};

}  // namespace

constinit const Kernels portable = kernels_of<Portable>("portable");

}  // namespace protomark::kernels
