// For every machine: 128-bit vectors as GCC and Clang translate them to what the target has.
#include "kernels/generic_encoder.h"
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

using Bytes [[gnu::vector_size(16)]] = std::int8_t;
using Shorts16 [[gnu::vector_size(32)]] = std::int16_t;
using Shorts [[gnu::vector_size(16)]] = std::int16_t;
using Ints [[gnu::vector_size(16)]] = std::int32_t;
using Longs [[gnu::vector_size(16)]] = std::uint64_t;

template <typename Vector>
Vector load_vector(const void* p) {
  Vector v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}

// 64 bytes. All functions of these are loops over the four vectors.
template <typename Vector>
struct Four {
  Vector v[4];
};
template <typename Vector>
Four<Vector> load_four(const void* p) {
  Four<Vector> result;
  for (int i = 0; i < 4; ++i)
    result.v[i] = load_vector<Vector>(static_cast<const char*>(p) + 16 * i);
  return result;
}
template <typename Vector>
Four<Vector> plus(const Four<Vector>& a, const Four<Vector>& b) {
  Four<Vector> result;
  for (int i = 0; i < 4; ++i) result.v[i] = a.v[i] + b.v[i];
  return result;
}

struct Portable {
  using Sums16 = Four<Shorts>;
  static constexpr std::size_t kSums16 = 32;
  static Sums16 zero16() { return {}; }
  static Sums16 load16(const std::int16_t* sums) { return load_four<Shorts>(sums); }
  static Sums16 widen(const std::int8_t* weights) {
    Sums16 result;
    for (int i = 0; i < 4; i += 2) {
      // Two vectors at a time, which is two instructions.
      const auto both = __builtin_convertvector(load_vector<Bytes>(weights + 8 * i), Shorts16);
      __builtin_memcpy(&result.v[i], &both, sizeof both);
    }
    return result;
  }
  static Sums16 add16(const Sums16& a, const Sums16& b) { return plus(a, b); }
  static void store16(std::int16_t* sums, const Sums16& a) { __builtin_memcpy(sums, &a, sizeof a); }

  using Sums = Four<Ints>;
  static Sums zero() { return {}; }
  static Sums load(const std::int32_t* sums) { return load_four<Ints>(sums); }
  static void store(std::int32_t* sums, const Sums& a) { __builtin_memcpy(sums, &a, sizeof a); }
  static Sums add(const Sums& a, const Sums& b) { return plus(a, b); }
  static Sums half(const Sums& a) {
    Sums result;
    for (int i = 0; i < 4; ++i) result.v[i] = a.v[i] >> 1;
    return result;
  }

  // 4 dimensions of a row, a 32-bit lane, as 16-bit numbers (0, 2) and (1, 3). The product of two
  // bytes fits 16 bits as well.
  struct Codes {
    Shorts even[4], odd[4];
  };
  static Codes load_codes(const std::int8_t* codes) {
    Codes result;
    for (int i = 0; i < 4; ++i) {
      const auto both = load_vector<Shorts>(codes + 16 * i);
      result.even[i] = both << 8 >> 8;
      result.odd[i] = both >> 8;
    }
    return result;
  }
  struct Query {
    Shorts even, odd;
  };
  static void dot(Sums& sums, const Query& q, const Codes& codes) {
    for (int i = 0; i < 4; ++i) {
      sums.v[i] += pairs(codes.even[i] * q.even) + pairs(codes.odd[i] * q.odd);
    }
  }
  struct Step {
    std::uint8_t codes[4];
  };
  static const Step* steps(const std::uint8_t* codes, std::size_t, Step*) {
    return reinterpret_cast<const Step*>(codes);
  }
  static Query broadcast(const Step& step) {
    const auto four = __builtin_bit_cast(std::int32_t, step);
    const Ints all = {four, four, four, four};
    return {(Shorts)(all & 0xff00ff), (Shorts)(all >> 8 & 0xff00ff)};
  }

  static constexpr int kDenseBatch = 1;
  static constexpr std::size_t kLanes = 1;
  static constexpr int kDenseGroups = 1;
  using Inputs = const std::uint8_t*;
  static Inputs inputs(const std::uint8_t* x) { return x; }
  template <int>
  static void dot_lane(Sums& sums, Inputs x, const Codes& weights) {
    dot(sums, broadcast(*steps(x, 1, nullptr)), weights);
  }
  static Sums dense_start(const std::int8_t*, std::size_t) { return {}; }

  static constexpr std::size_t kBlocks = 1;
  // The biases are -|p|^2 - 256 sum(p), as queries come as q + 128.
  class Norms {
   public:
    void add(const Codes& p) {
      for (int i = 0; i < 4; ++i) {
        biases_.v[i] -= pairs(p.even[i] * p.even[i]) + pairs(p.odd[i] * p.odd[i]) +
                        ((pairs(p.even[i]) + pairs(p.odd[i])) << 8);
      }
    }
    Sums biases() const { return biases_; }

   private:
    Sums biases_ = {};
  };
  using Flags = Ints;
  static Flags at_least(const Sums& sums, std::int32_t threshold) {
    return (sums.v[0] >= threshold) | (sums.v[1] >= threshold) | (sums.v[2] >= threshold) |
           (sums.v[3] >= threshold);
  }
  static Flags either(Flags a, Flags b) { return a | b; }
  static bool any(Flags flags) { return (((Longs)flags)[0] | ((Longs)flags)[1]) != 0; }
  static unsigned near_rows(const Sums& sums, std::int32_t threshold) {
    unsigned bits = 0;
    for (unsigned r = 0; r < kCodeRows; ++r) {
      bits |= (sums.v[r / 4][r % 4] >= threshold ? 1u : 0u) << r;
    }
    return bits;
  }

  static constexpr int kWordQueries = 1;
  static constexpr std::size_t kByteWords = 0;
  using Words = Four<Longs>;
  using Counts = Four<Longs>;
  static Words load_words(const std::uint64_t* words) { return load_four<Longs>(words); }
  static void add_bits(Counts& counts, std::uint64_t query, const Words& row) {
    for (int i = 0; i < 4; ++i) counts.v[i] += popcounts(row.v[i] ^ query);
  }
  static unsigned near_words(const Counts& counts, std::int32_t limit) {
    unsigned bits = 0;
    for (unsigned r = 0; r < kWordRows; ++r) {
      bits |= (static_cast<std::int32_t>(counts.v[r / 2][r % 2]) <= limit ? 1u : 0u) << r;
    }
    return bits;
  }
  static void store_counts(std::int64_t* to, const Counts& counts) {
    __builtin_memcpy(to, &counts, sizeof counts);
  }

 private:
  // The sums of the two 16-bit numbers of each lane.
  static Ints pairs(Shorts numbers) { return ((Ints)numbers << 16 >> 16) + ((Ints)numbers >> 16); }
  static Longs popcounts(Longs x) {
    x -= (x >> 1) & 0x5555555555555555u;
    x = (x & 0x3333333333333333u) + ((x >> 2) & 0x3333333333333333u);
    x = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0fu;
    x += x >> 8;
    x += x >> 16;
    x += x >> 32;
    return x & 0xff;
  }
};

// Rounds half up. s * multiplier is below 2^62, so adding 2^61 at most cannot overflow.
template <typename Sum>
void activate_any_shift(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
                        std::size_t stride) {
  const std::int64_t half = std::int64_t{1} << (a.shift - 1);
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    for (std::size_t o = 0; o < kOutputs; ++o) {
      const std::int64_t s = std::int64_t{sums[o]} + a.bias[o];
      const std::int64_t t = (s * a.multipliers[o] + half) >> a.shift;
      next[o] = a.table[t < -128 ? 0 : t > 127 ? 255 : t + 128];
    }
  }
}

void code_unpack4(const std::uint8_t* packed, std::size_t blocks, std::size_t dim, int scale,
                  std::int8_t* codes) {
  std::int8_t levels[16];
  for (int u = 0; u < 16; ++u) levels[u] = static_cast<std::int8_t>(scale * (2 * u - 15));
  for (std::size_t b = 0; b < blocks; ++b) {
    for (std::size_t d = 0; d < dim; d += 4, codes += 4 * kCodeRows) {
      const int shift = d % 8 == 0 ? 0 : 4;
      for (std::size_t i = 0; i < 4 * kCodeRows; ++i) {
        codes[i] = d + i % 4 < dim ? levels[packed[i] >> shift & 15] : std::int8_t{0};
      }
      // Go on where both halves of the bytes were read, or there is no second half.
      if (shift == 4 || d + 4 >= dim) packed += 4 * kCodeRows;
    }
  }
}

}  // namespace

const Kernels portable = {.name = "portable",
                          .bit_sums = bit_sums<Portable>,
                          .bit_sum = bit_sum<Portable>,
                          .dense = dense<Portable>,
                          .activate16 = activate_any_shift<std::int16_t>,
                          .activate32 = activate_any_shift<std::int32_t>,
                          .code_biases = code_biases<Portable>,
                          .code_unpack4 = code_unpack4,
                          .code_scan = code_scan<Portable>,
                          .hamming_scan = hamming_scan<Portable>};

}  // namespace protomark::kernels
