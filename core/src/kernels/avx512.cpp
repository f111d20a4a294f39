// AVX-512 with VBMI, VNNI (byte dot products) and VPOPCNTDQ: Ice Lake, Zen 4 and later.
#include <immintrin.h>

#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

struct Avx512 {
  using Ints = Vector<int32_t, 64>;
  using Sums16 = Pack<Vector<int16_t, 64>, 1>;
  using Sums = Pack<Ints, 1>;

  static Sums16 widen(const int8_t* weights) {
    return {(Vector<int16_t, 64>)_mm512_cvtepi8_epi16(load<__m256i>(weights))};
  }

  using Codes = Ints;
  static Codes load_codes(const int8_t* codes) { return load<Codes>(codes); }
  using Step = uint8_t[4];
  static Ints query(const uint8_t* codes) { return Ints{} + load<int32_t>(codes); }
  // GCC copies every accumulator of _mm512_dpbusd_epi32 twice per step.
  static void dot(Sums& sums, Ints u, Codes s) {
    __asm__("vpdpbusd %2, %1, %0" : "+v"(sums.v[0]) : "v"(u), "v"(s));
  }
  static constexpr int kDenseBatch = 8;
  static constexpr int kDenseGroups = 2;

  static Ints load_ints(const int32_t* sums) { return load<Ints>(sums); }
  static Ints load_ints(const int16_t* sums) {
    return (Ints)_mm512_cvtepi16_epi32(load<__m256i>(sums));
  }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, Ints bias, Ints multipliers, int shift) {
    const auto s = (__m512i)(sums + bias), m = (__m512i)multipliers;
    const __m512i half = _mm512_set1_epi64(int64_t{1} << (shift - 1));
    const __m512i even = _mm512_add_epi64(_mm512_mul_epi32(s, m), half);
    const __m512i odd = _mm512_add_epi64(
        _mm512_mul_epi32(_mm512_srli_epi64(s, 32), _mm512_srli_epi64(m, 32)), half);
    const __m512i upper = _mm512_mask_shuffle_epi32(odd, 0x5555, even, _MM_PERM_DDBB);
    return (Ints)_mm512_sra_epi32(upper, _mm_cvtsi32_si128(shift - 32));
  }
  class Table {
   public:
    explicit Table(const uint8_t* bytes) {
      for (int q = 0; q < 4; ++q) table_[q] = load<__m512i>(bytes + 64 * q);
    }
    __m512i operator()(Ints a, Ints b, Ints c, Ints d) const {
      // Packing works within each 128 bits.
      const __m512i order = _mm512_set_epi32(15, 11, 7, 3, 14, 10, 6, 2, 13, 9, 5, 1, 12, 8, 4, 0);
      const __m512i low = _mm512_packs_epi32((__m512i)a, (__m512i)b);
      const __m512i high = _mm512_packs_epi32((__m512i)c, (__m512i)d);
      const __m512i t = _mm512_permutexvar_epi32(order, _mm512_packs_epi16(low, high));
      // The lower 7 bits choose in each half of the table, the sign bit the half.
      const __m512i above = _mm512_permutex2var_epi8(table_[2], t, table_[3]);
      const __m512i below = _mm512_permutex2var_epi8(table_[0], t, table_[1]);
      return _mm512_mask_mov_epi8(above, _mm512_movepi8_mask(t), below);
    }

   private:
    __m512i table_[4];
  };

  static constexpr size_t kBlocks = 4;
  // The biases are -|p|^2 - 256 sum(p), as queries come as q + 128.
  class Norms {
   public:
    void add(Codes p) {
      // p (p + 128): one product of an unsigned and a signed byte in place of p p.
      dot(products_, p ^ (Ints)_mm512_set1_epi8(-128), p);
      dot(sum_, (Ints)_mm512_set1_epi8(1), p);
    }
    Sums biases() const { return {-products_.v[0] - (sum_.v[0] << 7)}; }

   private:
    Sums products_ = {}, sum_ = {};
  };
  static Sums max(const Sums& a, const Sums& b) {
    return {(Ints)_mm512_max_epi32((__m512i)a.v[0], (__m512i)b.v[0])};
  }
  using Flags = unsigned;
  static unsigned near_rows(const Sums& sums, int32_t threshold) {
    return _mm512_cmpgt_epi32_mask((__m512i)sums.v[0], _mm512_set1_epi32(threshold));
  }
  static Flags above(const Sums& sums, int32_t threshold) { return near_rows(sums, threshold); }
  static bool any(Flags flags) { return flags != 0; }

  // Looks up 64 rows at a time by permutations of bytes.
  static constexpr size_t kDecodeBlocks = 4;
  static void decode(const WordsOf4& words, size_t blocks, const int8_t* table, int8_t* codes,
                     size_t codes_block) {
    // The last block stands for those that there are not.
    const size_t second = blocks < 2 ? 0 : 1, third = blocks < 3 ? second : 2;
    const size_t fourth = blocks - 1;
    __m512i numbers[4];
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
      const auto of_block = [&](size_t block) {
        return load<__m128i>(words.of_number[j] + block * words.words_block);
      };
      __m512i w = _mm512_castsi128_si512(of_block(0));
      w = _mm512_inserti32x4(w, of_block(second), 1);
      w = _mm512_inserti32x4(w, of_block(third), 2);
      w = _mm512_inserti32x4(w, of_block(fourth), 3);
      const auto quarter = [&](int q) { return load<__m512i>(table + 256 * j + 64 * q); };
      const __m512i below = _mm512_permutex2var_epi8(quarter(0), w, quarter(1));
      const __m512i above = _mm512_permutex2var_epi8(quarter(2), w, quarter(3));
      numbers[j] = _mm512_mask_mov_epi8(below, _mm512_movepi8_mask(w), above);
    }
    // Unpacking works within each 128 bits, which hold a block: rows 0 to 3, 4 to 7, ... of each.
    const __m512i low01 = _mm512_unpacklo_epi8(numbers[0], numbers[1]);
    const __m512i low23 = _mm512_unpacklo_epi8(numbers[2], numbers[3]);
    const __m512i high01 = _mm512_unpackhi_epi8(numbers[0], numbers[1]);
    const __m512i high23 = _mm512_unpackhi_epi8(numbers[2], numbers[3]);
    const __m512i rows[4] = {
        _mm512_unpacklo_epi16(low01, low23), _mm512_unpackhi_epi16(low01, low23),
        _mm512_unpacklo_epi16(high01, high23), _mm512_unpackhi_epi16(high01, high23)};
#pragma GCC unroll 4
    for (int i = 0; i < 4; ++i) {
      int8_t* to = codes + 16 * i;
      store(to + fourth * codes_block, _mm512_extracti32x4_epi32(rows[i], 3));
      store(to + third * codes_block, _mm512_extracti32x4_epi32(rows[i], 2));
      store(to + second * codes_block, _mm512_extracti32x4_epi32(rows[i], 1));
      store(to, _mm512_castsi512_si128(rows[i]));
    }
  }

  static constexpr int kWordQueries = 8;
  using Words = Pack<Vector<uint64_t, 64>, 1>;
  static void add_bits(Words& counts, uint64_t query, const Words& row) {
    const auto differ = (__m512i)(row.v[0] ^ query);
    counts.v[0] += (Vector<uint64_t, 64>)_mm512_popcnt_epi64(differ);
  }
  static unsigned near_words(const Words& counts, int32_t limit) {
    return _mm512_cmple_epi64_mask((__m512i)counts.v[0], _mm512_set1_epi64(limit));
  }
};

}  // namespace

constinit const Kernels avx512 = kernels_of<Avx512>("avx512");

}  // namespace protomark::kernels
