// AVX-512 with VBMI, VNNI (byte dot products) and VPOPCNTDQ: Ice Lake, Zen 4 and later.
#include <immintrin.h>

#include "kernels/generic_encoder.h"
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

struct Avx512 {
  using Sums16 = __m512i;
  static constexpr std::size_t kSums16 = 32;
  static Sums16 zero16() { return _mm512_setzero_si512(); }
  static Sums16 load16(const std::int16_t* sums) { return _mm512_loadu_si512(sums); }
  static Sums16 widen(const std::int8_t* weights) {
    return _mm512_cvtepi8_epi16(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(weights)));
  }
  static Sums16 add16(Sums16 a, Sums16 b) { return _mm512_add_epi16(a, b); }
  static void store16(std::int16_t* sums, Sums16 a) { _mm512_storeu_si512(sums, a); }

  using Sums = __m512i;
  static Sums zero() { return _mm512_setzero_si512(); }
  static Sums load(const std::int32_t* sums) { return _mm512_loadu_si512(sums); }
  static void store(std::int32_t* sums, Sums a) { _mm512_storeu_si512(sums, a); }
  static Sums add(Sums a, Sums b) { return _mm512_add_epi32(a, b); }
  static Sums half(Sums a) { return _mm512_srai_epi32(a, 1); }
  static Sums max(Sums a, Sums b) { return _mm512_max_epi32(a, b); }

  using Codes = __m512i;
  static Codes load_codes(const std::int8_t* codes) { return _mm512_loadu_si512(codes); }
  // _mm512_dpbusd_epi32 in place: of that, GCC makes two copies of every accumulator a step.
  static void dot(Sums& sums, __m512i u, Codes s) {
    __asm__("vpdpbusd %2, %1, %0" : "+v"(sums) : "v"(u), "v"(s));
  }

  struct Step {
    std::uint8_t codes[4];
  };
  static const Step* steps(const std::uint8_t* codes, std::size_t, Step*) {
    return reinterpret_cast<const Step*>(codes);
  }
  static __m512i broadcast(const Step& step) {
    return _mm512_set1_epi32(__builtin_bit_cast(std::int32_t, step));
  }

  static constexpr int kDenseBatch = 8;
  static constexpr std::size_t kLanes = 1;
  static constexpr int kDenseGroups = 2;
  using Inputs = const std::uint8_t*;
  static Inputs inputs(const std::uint8_t* x) { return x; }
  template <int Lane>
  static void dot_lane(Sums& sums, Inputs x, Codes weights) {
    dot(sums, broadcast(*steps(x + 4 * Lane, 1, nullptr)), weights);
  }
  static Sums dense_start(const std::int8_t*, std::size_t) { return zero(); }

  static constexpr std::size_t kInts = 16;
  using Ints = __m512i;
  static Ints load_ints(const std::int32_t* sums) { return load(sums); }
  static Ints load_ints(const std::int16_t* sums) {
    return _mm512_cvtepi16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(sums)));
  }
  struct Factors {
    __m512i bias, even, odd;
  };
  static Factors factors(const std::int32_t* bias, const std::int32_t* multipliers) {
    const __m512i even = load(multipliers);
    return {load(bias), even, _mm512_srli_epi64(even, 32)};
  }
  struct Rounding {
    __m512i half;
    __m128i shift;
  };
  static Rounding rounding(int shift) {
    return {_mm512_set1_epi64(std::int64_t{1} << (shift - 1)), _mm_cvtsi32_si128(shift - 32)};
  }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, const Factors& f, const Rounding& r) {
    const __m512i s = _mm512_add_epi32(sums, f.bias);
    const __m512i even = _mm512_add_epi64(_mm512_mul_epi32(s, f.even), r.half);
    const __m512i odd = _mm512_add_epi64(_mm512_mul_epi32(_mm512_srli_epi64(s, 32), f.odd), r.half);
    return _mm512_sra_epi32(_mm512_mask_shuffle_epi32(odd, 0x5555, even, _MM_PERM_DDBB), r.shift);
  }
  class Table {
   public:
    explicit Table(const std::uint8_t* bytes) {
      for (int q = 0; q < 4; ++q) table_[q] = _mm512_loadu_si512(bytes + 64 * q);
    }
    __m512i operator()(__m512i a, __m512i b, __m512i c, __m512i d) const {
      // Packing works within each 128 bits.
      const __m512i order = _mm512_set_epi32(15, 11, 7, 3, 14, 10, 6, 2, 13, 9, 5, 1, 12, 8, 4, 0);
      const __m512i t = _mm512_permutexvar_epi32(
          order, _mm512_packs_epi16(_mm512_packs_epi32(a, b), _mm512_packs_epi32(c, d)));
      // The lower 7 bits choose in each half of the table, the sign bit the half.
      const __m512i above = _mm512_permutex2var_epi8(table_[2], t, table_[3]);
      const __m512i below = _mm512_permutex2var_epi8(table_[0], t, table_[1]);
      return _mm512_mask_mov_epi8(above, _mm512_movepi8_mask(t), below);
    }

   private:
    __m512i table_[4];
  };
  static void store_bytes(std::uint8_t* to, __m512i bytes) { _mm512_storeu_si512(to, bytes); }

  static constexpr std::size_t kBlocks = 4;
  // The biases are -|p|^2 - 256 sum(p), as queries come as q + 128.
  class Norms {
   public:
    void add(Codes p) {
      // p (p + 128): one product of an unsigned and a signed byte in place of p p.
      dot(products_, _mm512_xor_si512(p, _mm512_set1_epi8(-128)), p);
      dot(sum_, _mm512_set1_epi8(1), p);
    }
    Sums biases() const {
      return _mm512_sub_epi32(zero(), _mm512_add_epi32(products_, _mm512_slli_epi32(sum_, 7)));
    }

   private:
    Sums products_ = _mm512_setzero_si512(), sum_ = _mm512_setzero_si512();
  };
  using Flags = unsigned;
  static unsigned near_rows(Sums sums, std::int32_t threshold) {
    return _mm512_cmpge_epi32_mask(sums, _mm512_set1_epi32(threshold));
  }
  static Flags at_least(Sums sums, std::int32_t threshold) { return near_rows(sums, threshold); }
  static Flags either(Flags a, Flags b) { return a | b; }
  static bool any(Flags flags) { return flags != 0; }

  static constexpr int kWordQueries = 8;
  static constexpr std::size_t kByteWords = 0;
  using Words = __m512i;
  using Counts = __m512i;
  static Words load_words(const std::uint64_t* words) { return _mm512_loadu_si512(words); }
  static void add_bits(Counts& counts, std::uint64_t query, Words row) {
    const __m512i differ = _mm512_xor_si512(_mm512_set1_epi64(static_cast<long long>(query)), row);
    counts = _mm512_add_epi64(counts, _mm512_popcnt_epi64(differ));
  }
  static unsigned near_words(Counts counts, std::int32_t limit) {
    return _mm512_cmple_epi64_mask(counts, _mm512_set1_epi64(limit));
  }
  static void store_counts(std::int64_t* to, Counts counts) { _mm512_storeu_si512(to, counts); }
};

void code_unpack4(const std::uint8_t* packed, std::size_t blocks, std::size_t dim, int scale,
                  std::int8_t* codes) {
  // The shuffle looks bytes up in each 16 of a register: the same 16 levels four times.
  std::int8_t table[64];
  for (int i = 0; i < 64; ++i) table[i] = static_cast<std::int8_t>(scale * (2 * (i % 16) - 15));
  const __m512i levels = _mm512_loadu_si512(table);
  const __m512i low = _mm512_set1_epi8(15);
  // Which of the last 4 dimensions there are.
  const std::size_t last = dim % 4 == 0 ? 4 : dim % 4;
  const __mmask64 tail = 0x1111111111111111u * ((1u << last) - 1);
  for (std::size_t b = 0; b < blocks; ++b) {
    for (std::size_t d = 0; d < dim; d += 8, packed += 64) {
      const __m512i bytes = _mm512_loadu_si512(packed);
      const __mmask64 first = d + 4 < dim ? ~__mmask64{0} : tail;
      _mm512_storeu_si512(codes,
                          _mm512_maskz_shuffle_epi8(first, levels, _mm512_and_si512(bytes, low)));
      codes += 64;
      if (d + 4 >= dim) continue;
      const __mmask64 second = d + 8 < dim ? ~__mmask64{0} : tail;
      const __m512i high = _mm512_and_si512(_mm512_srli_epi16(bytes, 4), low);
      _mm512_storeu_si512(codes, _mm512_maskz_shuffle_epi8(second, levels, high));
      codes += 64;
    }
  }
}

}  // namespace

const Kernels avx512 = {.name = "avx512",
                        .bit_sums = bit_sums<Avx512>,
                        .bit_sum = bit_sum<Avx512>,
                        .dense = dense<Avx512>,
                        .activate16 = activate<Avx512, std::int16_t>,
                        .activate32 = activate<Avx512, std::int32_t>,
                        .code_biases = code_biases<Avx512>,
                        .code_unpack4 = code_unpack4,
                        .code_scan = code_scan<Avx512>,
                        .hamming_scan = hamming_scan<Avx512>};

}  // namespace protomark::kernels
