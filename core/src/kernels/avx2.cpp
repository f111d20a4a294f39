// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

struct Avx2 : ByPairs<Avx2, 32> {
  using Sums16 = Pack<Shorts, 1>;
  static Sums16 widen(const int8_t* weights) {
    return {(Shorts)_mm256_cvtepi8_epi16(load<__m128i>(weights))};
  }
  static Ints multiply_pairs(Shorts a, Shorts b) {
    return (Ints)_mm256_madd_epi16((__m256i)a, (__m256i)b);
  }
  // Two 16-bit numbers each.
  struct Step {
    int32_t even, odd;
  };
  static void convert(const uint8_t* u, size_t n, Step* steps) {
    for (size_t i = 0; i < n; ++i, u += 4) steps[i] = {u[0] | u[2] << 16, u[1] | u[3] << 16};
  }
  using ByPairs::query;
  static Query query(const Step& step) {
    return {(Shorts)_mm256_set1_epi32(step.even), (Shorts)_mm256_set1_epi32(step.odd)};
  }
  static constexpr int kDenseBatch = 4;
  static constexpr int kDenseGroups = 1;

  static Ints load_ints(const int32_t* sums) { return load<Ints>(sums); }
  static Ints load_ints(const int16_t* sums) {
    return (Ints)_mm256_cvtepi16_epi32(load<__m128i>(sums));
  }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, Ints bias, Ints multipliers, int shift) {
    const auto s = (__m256i)(sums + bias), m = (__m256i)multipliers;
    const __m256i half = _mm256_set1_epi64x(int64_t{1} << (shift - 1));
    const __m256i even = _mm256_add_epi64(_mm256_mul_epi32(s, m), half);
    const __m256i odd = _mm256_add_epi64(
        _mm256_mul_epi32(_mm256_srli_epi64(s, 32), _mm256_srli_epi64(m, 32)), half);
    const __m256i upper = _mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0b10101010);
    return (Ints)_mm256_sra_epi32(upper, _mm_cvtsi32_si128(shift - 32));
  }
  // Looks bytes up in 256 entries, 16 at a time: in step k of each half, only bytes that are not
  // negative after subtracting 16 k choose an entry. Entries are stored as differences from those
  // 16 before, so that the steps up to the right one add up to it.
  class Table {
   public:
    explicit Table(const uint8_t* entries) {
      for (int k = 0; k < 16; ++k) {
        steps_[k] = part(entries + 16 * k);
        if (k % 8 != 0) steps_[k] = _mm256_xor_si256(steps_[k], part(entries + 16 * (k - 1)));
      }
    }
    __m256i operator()(Ints a, Ints b, Ints c, Ints d) const {
      // Packing works within each 128 bits.
      const __m256i order = _mm256_set_epi32(7, 3, 6, 2, 5, 1, 4, 0);
      const __m256i low = _mm256_packs_epi32((__m256i)a, (__m256i)b);
      const __m256i high = _mm256_packs_epi32((__m256i)c, (__m256i)d);
      __m256i t = _mm256_permutevar8x32_epi32(_mm256_packs_epi16(low, high), order);
      __m256i below = _mm256_xor_si256(t, _mm256_set1_epi8(-128));
      __m256i result = _mm256_setzero_si256();
      for (int k = 0; k < 8; ++k) {
        result = _mm256_xor_si256(result, _mm256_shuffle_epi8(steps_[k], below));
        result = _mm256_xor_si256(result, _mm256_shuffle_epi8(steps_[8 + k], t));
        below = _mm256_subs_epi8(below, _mm256_set1_epi8(16));
        t = _mm256_subs_epi8(t, _mm256_set1_epi8(16));
      }
      return result;
    }

   private:
    static __m256i part(const uint8_t* entries) {
      return _mm256_broadcastsi128_si256(load<__m128i>(entries));
    }

    __m256i steps_[16];
  };

  static constexpr size_t kBlocks = 1;
  using Flags = Ints;
  static Flags above(const Sums& sums, int32_t threshold) {
    return (Ints)_mm256_max_epi32((__m256i)sums.v[0], (__m256i)sums.v[1]) > threshold;
  }
  static bool any(Flags flags) { return _mm256_movemask_epi8((__m256i)flags) != 0; }
  static unsigned near_rows(const Sums& sums, int32_t threshold) {
    const auto bits = [&](Ints half) {
      return static_cast<unsigned>(_mm256_movemask_ps((__m256)(half > threshold)));
    };
    return bits(sums.v[0]) | bits(sums.v[1]) << 8;
  }

  static constexpr int kWordQueries = 2;
  using Words = Pack<Vector<uint64_t, 32>, 2>;
  using BitCounts = Pack<Vector<uint8_t, 32>, 2>;
  static constexpr size_t kByteWords = 31;  // a byte counts 31 * 8 bits
  static void add_bits(BitCounts& bytes, uint64_t query, const Words& row) {
    const __m256i table = _mm256_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4,  //
                                           0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
    const __m256i nibble = _mm256_set1_epi8(15);
    for (int i = 0; i < 2; ++i) {
      const auto differ = (__m256i)(row.v[i] ^ query);
      const __m256i low = _mm256_and_si256(differ, nibble);
      const __m256i high = _mm256_and_si256(_mm256_srli_epi16(differ, 4), nibble);
      bytes.v[i] += (Vector<uint8_t, 32>)_mm256_add_epi8(_mm256_shuffle_epi8(table, low),
                                                         _mm256_shuffle_epi8(table, high));
    }
  }
  static void add_counts(Words& counts, const BitCounts& bytes) {
    for (int i = 0; i < 2; ++i) {
      const __m256i sums = _mm256_sad_epu8((__m256i)bytes.v[i], _mm256_setzero_si256());
      counts.v[i] += (Vector<uint64_t, 32>)sums;
    }
  }
  static unsigned near_words(const Words& counts, int32_t limit) {
    const __m256i limits = _mm256_set1_epi64x(limit);
    const auto far = [&](auto half) {
      return static_cast<unsigned>(
          _mm256_movemask_pd((__m256d)_mm256_cmpgt_epi64((__m256i)half, limits)));
    };
    return 0xff ^ (far(counts.v[0]) | far(counts.v[1]) << 4);
  }
};

}  // namespace

constinit const Kernels avx2 = kernels_of<Avx2>("avx2");

}  // namespace protomark::kernels
