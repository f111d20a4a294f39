// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "kernels.h"

namespace protomark::kernels {
namespace {

std::int32_t load4(const void* p) {
  std::int32_t v;
  __builtin_memcpy(&v, p, 4);
  return v;
}

__m256i load(const void* p) { return _mm256_loadu_si256(static_cast<const __m256i*>(p)); }

void store(void* p, __m256i v) { _mm256_storeu_si256(static_cast<__m256i*>(p), v); }

// Outputs that are summed together, in one register.
constexpr std::size_t kQuarter = kOutputs / 4;

__m256i load_weights(const std::int8_t* weights) {
  return _mm256_cvtepi8_epi16(_mm_loadu_si128(reinterpret_cast<const __m128i*>(weights)));
}

// The sums of all subsets of 4 inputs, for each 4 of 64 inputs.
void fill_table(const std::int8_t* weights, __m256i* table) {
  for (int group = 0; group < 16; ++group, weights += 4 * kOutputs) {
    const __m256i a = load_weights(weights), b = load_weights(weights + kOutputs);
    const __m256i c = load_weights(weights + 2 * kOutputs);
    const __m256i d = load_weights(weights + 3 * kOutputs);
    const __m256i low[4] = {_mm256_setzero_si256(), a, b, _mm256_add_epi16(a, b)};
    const __m256i high[4] = {_mm256_setzero_si256(), c, d, _mm256_add_epi16(c, d)};
    for (const __m256i h : high) {
      for (const __m256i l : low) *table++ = _mm256_add_epi16(h, l);
    }
  }
}

void bit_sums(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
              std::size_t n, std::int16_t* sums) {
  __m256i table[256];
  for (std::size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (std::size_t quarter = 0; quarter < kOutputs; quarter += kQuarter) {
      fill_table(weights + quarter, table);
      std::int16_t* sum = sums + quarter;
      for (std::size_t i = 0; i < n; ++i, sum += kOutputs) {
        __m256i acc = w == 0 ? _mm256_setzero_si256() : load(sum);
        for (int group = 0; group < 16; ++group) {
          acc = _mm256_add_epi16(acc, table[16 * group + (words[i] >> (4 * group) & 15)]);
        }
        store(sum, acc);
      }
    }
  }
}

void bit_sum(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
             std::int16_t* sums) {
  __m256i acc[4] = {};
  for (std::size_t i = 0; i < count; ++i) {
    const std::int8_t* row = weights + set[i] * kOutputs;
    for (int q = 0; q < 4; ++q) acc[q] = _mm256_add_epi16(acc[q], load_weights(row + 16 * q));
  }
  for (int q = 0; q < 4; ++q) store(sums + 16 * q, acc[q]);
}

// `Batch` inputs share each load of 8 outputs' weights. Products of bytes are summed as 16-bit
// numbers, even and odd ones apart: the instruction for bytes would saturate.
template <int Batch>
void dense_tile(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                std::size_t stride, std::int32_t* sums) {
  const __m256i low = _mm256_set1_epi16(255);
  __m256i acc[Batch][2] = {};
  for (std::size_t j = 0; j < inputs; j += 4, weights += 64) {
    __m256i even[2], odd[2];
    for (int g = 0; g < 2; ++g) {
      const __m256i w = load(weights + 32 * g);
      even[g] = _mm256_srai_epi16(_mm256_slli_epi16(w, 8), 8);
      odd[g] = _mm256_srai_epi16(w, 8);
    }
    for (int i = 0; i < Batch; ++i) {
      const __m256i four = _mm256_set1_epi32(load4(x + i * stride + j));
      const __m256i x_even = _mm256_and_si256(four, low);
      const __m256i x_odd = _mm256_srli_epi16(four, 8);
      for (int g = 0; g < 2; ++g) {
        acc[i][g] = _mm256_add_epi32(acc[i][g], _mm256_add_epi32(_mm256_madd_epi16(x_even, even[g]),
                                                                 _mm256_madd_epi16(x_odd, odd[g])));
      }
    }
  }
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < 2; ++g) store(sums + i * kOutputs + 8 * g, acc[i][g]);
  }
}

void dense(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
           std::size_t stride, std::size_t n, std::size_t outputs, std::int32_t* sums) {
  constexpr int kBatch = 4;
  for (std::size_t o = 0; o < outputs; o += 16, weights += 16 * inputs, sums += 16) {
    std::size_t i = 0;
    for (; i + kBatch <= n; i += kBatch) {
      dense_tile<kBatch>(weights, inputs, x + i * stride, stride, sums + i * kOutputs);
    }
    for (; i < n; ++i) {
      dense_tile<1>(weights, inputs, x + i * stride, stride, sums + i * kOutputs);
    }
  }
}

__m256i load_sums(const std::int32_t* sums) { return load(sums); }

__m256i load_sums(const std::int16_t* sums) {
  return _mm256_cvtepi16_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(sums)));
}

// The upper half of a 64-bit product, rounded and shifted, for 8 outputs.
__m256i scale(__m256i s, __m256i multipliers, __m256i half, __m128i shift) {
  const __m256i even = _mm256_add_epi64(_mm256_mul_epi32(s, multipliers), half);
  const __m256i odd = _mm256_add_epi64(
      _mm256_mul_epi32(_mm256_srli_epi64(s, 32), _mm256_srli_epi64(multipliers, 32)), half);
  const __m256i upper = _mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0b10101010);
  return _mm256_sra_epi32(upper, shift);
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

  // The entry 128 + t for each signed byte t.
  __m256i operator()(__m256i t) const {
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
    return _mm256_broadcastsi128_si256(_mm_loadu_si128(reinterpret_cast<const __m128i*>(entries)));
  }

  __m256i steps_[16];
};

template <typename Sum>
void activate(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
              std::size_t stride) {
  const Table table(a.table);
  const __m256i half = _mm256_set1_epi64x(std::int64_t{1} << (a.shift - 1));
  const __m128i shift = _mm_cvtsi32_si128(a.shift - 32);
  const __m256i order = _mm256_set_epi32(7, 3, 6, 2, 5, 1, 4, 0);
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    for (std::size_t o = 0; o < kOutputs; o += 32) {
      __m256i t[4];
      for (int q = 0; q < 4; ++q) {
        const std::size_t at = o + 8 * q;
        const __m256i s = _mm256_add_epi32(load_sums(sums + at), load(a.bias + at));
        t[q] = scale(s, load(a.multipliers + at), half, shift);
      }
      // Packing works within each 128 bits.
      const __m256i packed =
          _mm256_packs_epi16(_mm256_packs_epi32(t[0], t[1]), _mm256_packs_epi32(t[2], t[3]));
      store(next + o, table(_mm256_permutevar8x32_epi32(packed, order)));
    }
  }
}

}  // namespace

const Kernels avx2 = {.name = "avx2",
                      .bit_sums = bit_sums,
                      .bit_sum = bit_sum,
                      .dense = dense,
                      .activate16 = activate<std::int16_t>,
                      .activate32 = activate<std::int32_t>};

}  // namespace protomark::kernels
