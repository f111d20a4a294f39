// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "kernels/generic_encoder.h"
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

__m256i load256(const void* p) { return _mm256_loadu_si256(static_cast<const __m256i*>(p)); }
__m128i load128(const void* p) { return _mm_loadu_si128(static_cast<const __m128i*>(p)); }
void store256(void* p, __m256i v) { _mm256_storeu_si256(static_cast<__m256i*>(p), v); }

struct Avx2 {
  using Sums16 = __m256i;
  static constexpr std::size_t kSums16 = 16;
  static Sums16 zero16() { return _mm256_setzero_si256(); }
  static Sums16 load16(const std::int16_t* sums) { return load256(sums); }
  static Sums16 widen(const std::int8_t* weights) { return _mm256_cvtepi8_epi16(load128(weights)); }
  static Sums16 add16(Sums16 a, Sums16 b) { return _mm256_add_epi16(a, b); }
  static void store16(std::int16_t* sums, Sums16 a) { store256(sums, a); }

  struct Sums {
    __m256i low, high;
  };
  static Sums zero() { return {_mm256_setzero_si256(), _mm256_setzero_si256()}; }
  static Sums load(const std::int32_t* sums) { return {load256(sums), load256(sums + 8)}; }
  static void store(std::int32_t* sums, Sums a) {
    store256(sums, a.low);
    store256(sums + 8, a.high);
  }
  static Sums add(Sums a, Sums b) {
    return {_mm256_add_epi32(a.low, b.low), _mm256_add_epi32(a.high, b.high)};
  }
  static Sums half(Sums a) { return {_mm256_srai_epi32(a.low, 1), _mm256_srai_epi32(a.high, 1)}; }

  // vpmaddubsw saturates, so bytes are widened: 4 dimensions of a row, a 32-bit lane, become 16-bit
  // (0, 2) and (1, 3), whose products vpmaddwd sums up within the lane.
  struct Codes {
    __m256i even_low, even_high, odd_low, odd_high;
  };
  static Codes load_codes(const std::int8_t* codes) {
    const __m256i low = load256(codes), high = load256(codes + 32);
    return {even(low), even(high), _mm256_srai_epi16(low, 8), _mm256_srai_epi16(high, 8)};
  }
  struct Query {
    __m256i even, odd;
  };
  static __m256i products(__m256i even, __m256i odd, __m256i other_even, __m256i other_odd) {
    return _mm256_add_epi32(_mm256_madd_epi16(even, other_even), _mm256_madd_epi16(odd, other_odd));
  }
  static void dot(Sums& sums, Query q, const Codes& c) {
    sums.low = _mm256_add_epi32(sums.low, products(c.even_low, c.odd_low, q.even, q.odd));
    sums.high = _mm256_add_epi32(sums.high, products(c.even_high, c.odd_high, q.even, q.odd));
  }

  // Two 16-bit numbers each.
  struct Step {
    std::int32_t even, odd;
  };
  static const Step* steps(const std::uint8_t* u, std::size_t n, Step* room) {
    for (std::size_t i = 0; i < n; ++i, u += 4) room[i] = {u[0] | u[2] << 16, u[1] | u[3] << 16};
    return room;
  }
  static Query broadcast(const Step& step) {
    return {_mm256_set1_epi32(step.even), _mm256_set1_epi32(step.odd)};
  }

  static constexpr int kDenseBatch = 4;
  static constexpr std::size_t kLanes = 1;
  static constexpr int kDenseGroups = 1;
  using Inputs = const std::uint8_t*;
  static Inputs inputs(const std::uint8_t* x) { return x; }
  template <int>
  static void dot_lane(Sums& sums, Inputs x, const Codes& weights) {
    std::int32_t bytes;
    __builtin_memcpy(&bytes, x, 4);
    const __m256i four = _mm256_set1_epi32(bytes);
    dot(sums, {_mm256_and_si256(four, _mm256_set1_epi16(255)), _mm256_srli_epi16(four, 8)},
        weights);
  }
  static Sums dense_start(const std::int8_t*, std::size_t) { return zero(); }

  static constexpr std::size_t kInts = 8;
  using Ints = __m256i;
  static Ints load_ints(const std::int32_t* sums) { return load256(sums); }
  static Ints load_ints(const std::int16_t* sums) { return _mm256_cvtepi16_epi32(load128(sums)); }
  struct Factors {
    __m256i bias, even, odd;
  };
  static Factors factors(const std::int32_t* bias, const std::int32_t* multipliers) {
    const __m256i even = load256(multipliers);
    return {load256(bias), even, _mm256_srli_epi64(even, 32)};
  }
  struct Rounding {
    __m256i half;
    __m128i shift;
  };
  static Rounding rounding(int shift) {
    return {_mm256_set1_epi64x(std::int64_t{1} << (shift - 1)), _mm_cvtsi32_si128(shift - 32)};
  }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, const Factors& f, const Rounding& r) {
    const __m256i s = _mm256_add_epi32(sums, f.bias);
    const __m256i even = _mm256_add_epi64(_mm256_mul_epi32(s, f.even), r.half);
    const __m256i odd = _mm256_add_epi64(_mm256_mul_epi32(_mm256_srli_epi64(s, 32), f.odd), r.half);
    const __m256i upper = _mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0b10101010);
    return _mm256_sra_epi32(upper, r.shift);
  }
  // Looks bytes up in 256 entries, 16 at a time: in step k of each half, only bytes that are not
  // negative after 16 k was taken away choose an entry. Entries are stored as differences to those
  // 16 before, so that the steps up to the right one add up to it.
  class Table {
   public:
    explicit Table(const std::uint8_t* entries) {
      for (int k = 0; k < 16; ++k) {
        steps_[k] = part(entries + 16 * k);
        if (k % 8 != 0) steps_[k] = _mm256_xor_si256(steps_[k], part(entries + 16 * (k - 1)));
      }
    }
    __m256i operator()(__m256i a, __m256i b, __m256i c, __m256i d) const {
      // Packing works within each 128 bits.
      const __m256i order = _mm256_set_epi32(7, 3, 6, 2, 5, 1, 4, 0);
      __m256i t = _mm256_permutevar8x32_epi32(
          _mm256_packs_epi16(_mm256_packs_epi32(a, b), _mm256_packs_epi32(c, d)), order);
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
    static __m256i part(const std::uint8_t* entries) {
      return _mm256_broadcastsi128_si256(load128(entries));
    }

    __m256i steps_[16];
  };
  static void store_bytes(std::uint8_t* to, __m256i bytes) { store256(to, bytes); }

  static constexpr std::size_t kBlocks = 1;
  // The biases are -|p|^2 - 256 sum(p), as queries come as q + 128.
  class Norms {
   public:
    void add(const Codes& p) {
      dot_itself(sums_.low, p.even_low, p.odd_low);
      dot_itself(sums_.high, p.even_high, p.odd_high);
    }
    Sums biases() const { return sums_; }

   private:
    static void dot_itself(__m256i& sum, __m256i even, __m256i odd) {
      const __m256i offset = _mm256_set1_epi16(256);
      sum = _mm256_sub_epi32(
          sum, products(even, odd, _mm256_add_epi16(even, offset), _mm256_add_epi16(odd, offset)));
    }

    Sums sums_ = zero();
  };
  using Flags = __m256i;
  // Flags are set where all rows are far, as there is no comparison for "at least".
  static Flags at_least(Sums sums, std::int32_t threshold) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(threshold), _mm256_max_epi32(sums.low, sums.high));
  }
  static Flags either(Flags a, Flags b) { return _mm256_and_si256(a, b); }
  static bool any(Flags flags) { return _mm256_movemask_epi8(flags) != -1; }
  static unsigned near_rows(Sums sums, std::int32_t threshold) {
    const __m256i least = _mm256_set1_epi32(threshold);
    const auto far = [&](__m256i half) {
      return static_cast<unsigned>(
          _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpgt_epi32(least, half))));
    };
    return 0xffff ^ (far(sums.low) | far(sums.high) << 8);
  }

  static constexpr int kWordQueries = 2;
  static constexpr std::size_t kByteWords = 31;  // a byte counts 31 * 8 bits
  struct Words {
    __m256i low, high;
  };
  using Bytes = Words;
  using Counts = Words;
  static Words load_words(const std::uint64_t* words) {
    return {load256(words), load256(words + 4)};
  }
  static void add_bits(Bytes& bytes, std::uint64_t query, Words row) {
    const __m256i q = _mm256_set1_epi64x(static_cast<long long>(query));
    bytes.low = _mm256_add_epi8(bytes.low, popcount_bytes(_mm256_xor_si256(q, row.low)));
    bytes.high = _mm256_add_epi8(bytes.high, popcount_bytes(_mm256_xor_si256(q, row.high)));
  }
  static void add_bytes(Counts& counts, Bytes bytes) {
    const __m256i zero = _mm256_setzero_si256();
    counts.low = _mm256_add_epi64(counts.low, _mm256_sad_epu8(bytes.low, zero));
    counts.high = _mm256_add_epi64(counts.high, _mm256_sad_epu8(bytes.high, zero));
  }
  static unsigned near_words(Counts counts, std::int32_t limit) {
    const __m256i most = _mm256_set1_epi64x(limit);
    const auto far = [&](__m256i half) {
      return static_cast<unsigned>(
          _mm256_movemask_pd(_mm256_castsi256_pd(_mm256_cmpgt_epi64(half, most))));
    };
    return 0xff ^ (far(counts.low) | far(counts.high) << 4);
  }
  static void store_counts(std::int64_t* to, Counts counts) {
    store256(to, counts.low);
    store256(to + 4, counts.high);
  }

 private:
  static __m256i even(__m256i codes) { return _mm256_srai_epi16(_mm256_slli_epi16(codes, 8), 8); }
  static __m256i popcount_bytes(__m256i x) {
    const __m256i table = _mm256_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4,  //
                                           0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
    const __m256i nibble = _mm256_set1_epi8(15);
    const __m256i low = _mm256_and_si256(x, nibble);
    const __m256i high = _mm256_and_si256(_mm256_srli_epi16(x, 4), nibble);
    return _mm256_add_epi8(_mm256_shuffle_epi8(table, low), _mm256_shuffle_epi8(table, high));
  }
};

}  // namespace

const Kernels avx2 = {.name = "avx2",
                      .bit_sums = bit_sums<Avx2>,
                      .bit_sum = bit_sum<Avx2>,
                      .dense = dense<Avx2>,
                      .activate16 = activate<Avx2, std::int16_t>,
                      .activate32 = activate<Avx2, std::int32_t>,
                      .code_biases = code_biases<Avx2>,
                      .code_scan = code_scan<Avx2>,
                      .hamming_scan = hamming_scan<Avx2>};

}  // namespace protomark::kernels
