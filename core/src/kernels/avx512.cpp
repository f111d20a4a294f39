// AVX-512 with VBMI, VNNI (byte dot products) and VPOPCNTDQ: Ice Lake, Zen 4 and later.
#include <immintrin.h>

#include "kernels.h"

namespace protomark::kernels {
namespace {

std::int32_t load4(const void* p) {
  std::int32_t v;
  __builtin_memcpy(&v, p, 4);
  return v;
}

// `Batch` inputs share each load of the weights.
template <int Batch>
void dense_batch(const PackedLayer& layer, const std::uint8_t* inputs, std::size_t outputs,
                 std::int32_t* sums) {
  for (std::size_t group = 0; group < outputs; group += kCodeRows) {
    __m512i acc[Batch];
    for (int i = 0; i < Batch; ++i) acc[i] = _mm512_loadu_si512(layer.bias + group);
    const std::int8_t* w = layer.weights + group * layer.inputs;
    for (std::size_t j = 0; j < layer.inputs; j += 4, w += 64) {
      const __m512i weights = _mm512_loadu_si512(w);
      for (int i = 0; i < Batch; ++i) {
        const __m512i x = _mm512_set1_epi32(load4(inputs + i * layer.inputs + j));
        acc[i] = _mm512_dpbusd_epi32(acc[i], x, weights);
      }
    }
    for (int i = 0; i < Batch; ++i) _mm512_storeu_si512(sums + i * outputs + group, acc[i]);
  }
}

void dense(const PackedLayer& layer, const std::uint8_t* inputs, std::size_t n, std::size_t outputs,
           std::int32_t* sums) {
  constexpr int kBatch = 8;
  std::size_t i = 0;
  for (; i + kBatch <= n; i += kBatch) {
    dense_batch<kBatch>(layer, inputs + i * layer.inputs, outputs, sums + i * outputs);
  }
  for (; i < n; ++i) dense_batch<1>(layer, inputs + i * layer.inputs, outputs, sums + i * outputs);
}

void code_offsets(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                  std::int32_t* offsets) {
  const __m512i ones = _mm512_set1_epi8(1);
  for (std::size_t b = 0; b < blocks; ++b) {
    __m512i norm = _mm512_setzero_si512();
    __m512i sum = _mm512_setzero_si512();
    for (std::size_t d = 0; d < dim; d += 4, packed += 64) {
      const __m512i p = _mm512_loadu_si512(packed);
      const __m512i magnitude = _mm512_abs_epi8(p);
      norm = _mm512_dpbusd_epi32(norm, magnitude, magnitude);
      sum = _mm512_dpbusd_epi32(sum, ones, p);
    }
    _mm512_storeu_si512(offsets + b * kCodeRows, _mm512_add_epi32(norm, _mm512_slli_epi32(sum, 8)));
  }
}

void code_unpack4(const std::uint8_t* packed, std::size_t blocks, std::size_t dim, int half_step,
                  std::int8_t* codes) {
  // The shuffle looks bytes up in each 16 of a register: the same 16 levels four times.
  std::int8_t table[64];
  for (int i = 0; i < 64; ++i) table[i] = static_cast<std::int8_t>(half_step * (2 * (i % 16) - 15));
  const __m512i levels = _mm512_loadu_si512(table);
  const __m512i low = _mm512_set1_epi8(15);
  // Which of 4 dimensions are there, for the last 4 of them.
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

std::size_t code_scan(const std::uint8_t* query, const std::int8_t* packed, std::size_t blocks,
                      std::size_t dim, const std::int32_t* offsets, std::int32_t limit, Hits hits) {
  const __m512i limits = _mm512_set1_epi32(limit);
  const __m512i lanes = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
  std::size_t found = 0;
  for (std::size_t b = 0; b < blocks; ++b) {
    __m512i dot = _mm512_setzero_si512();
    for (std::size_t d = 0; d < dim; d += 4, packed += 64) {
      const __m512i q = _mm512_set1_epi32(load4(query + d));
      dot = _mm512_dpbusd_epi32(dot, q, _mm512_loadu_si512(packed));
    }
    const __m512i distance =
        _mm512_sub_epi32(_mm512_loadu_si512(offsets + b * kCodeRows), _mm512_slli_epi32(dot, 1));
    const __mmask16 hit = _mm512_cmple_epi32_mask(distance, limits);
    if (hit) {
      const __m512i rows =
          _mm512_add_epi32(lanes, _mm512_set1_epi32(static_cast<int>(b * kCodeRows)));
      _mm512_mask_compressstoreu_epi32(hits.rows + found, hit, rows);
      _mm512_mask_compressstoreu_epi32(hits.distances + found, hit, distance);
      found += static_cast<std::size_t>(_mm_popcnt_u32(hit));
    }
  }
  return found;
}

std::size_t hamming_scan(const std::uint64_t* query, const std::uint64_t* packed,
                         std::size_t blocks, std::size_t words, std::int32_t limit, Hits hits) {
  const __m256i limits = _mm256_set1_epi32(limit);
  const __m256i lanes = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
  std::size_t found = 0;
  for (std::size_t b = 0; b < blocks; ++b) {
    __m512i count = _mm512_setzero_si512();
    for (std::size_t w = 0; w < words; ++w, packed += kWordRows) {
      const __m512i q = _mm512_set1_epi64(static_cast<long long>(query[w]));
      const __m512i differ = _mm512_xor_si512(q, _mm512_loadu_si512(packed));
      count = _mm512_add_epi64(count, _mm512_popcnt_epi64(differ));
    }
    const __m256i distance = _mm512_cvtepi64_epi32(count);
    const __mmask8 hit = _mm256_cmple_epi32_mask(distance, limits);
    if (hit) {
      const __m256i rows =
          _mm256_add_epi32(lanes, _mm256_set1_epi32(static_cast<int>(b * kWordRows)));
      _mm256_mask_compressstoreu_epi32(hits.rows + found, hit, rows);
      _mm256_mask_compressstoreu_epi32(hits.distances + found, hit, distance);
      found += static_cast<std::size_t>(_mm_popcnt_u32(hit));
    }
  }
  return found;
}

}  // namespace

const Kernels avx512 = {.name = "avx512",
                        .dense = dense,
                        .code_offsets = code_offsets,
                        .code_unpack4 = code_unpack4,
                        .code_scan = code_scan,
                        .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
