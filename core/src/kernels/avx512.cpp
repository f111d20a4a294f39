// AVX-512 with VBMI, VNNI (byte dot products) and VPOPCNTDQ: Ice Lake, Zen 4 and later.
#include <immintrin.h>

#include "avx512_hits.h"
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

// -|p|^2 - 256 sum(p), see avx512_hits.h.
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                 std::int32_t* biases) {
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
    const __m512i offset = _mm512_add_epi32(norm, _mm512_slli_epi32(sum, 8));
    _mm512_storeu_si512(biases + b * kCodeRows, _mm512_sub_epi32(_mm512_setzero_si512(), offset));
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

// _mm512_dpbusd_epi32 in place: of that, GCC makes two copies of every accumulator a step.
void add_products(__m512i& acc, __m512i u, __m512i s) {
  __asm__("vpdpbusd %2, %1, %0" : "+v"(acc) : "v"(u), "v"(s));
}

struct CodeTile {
  const std::uint8_t* queries;
  const std::int32_t* limits;
  const std::int8_t* rows;
  const std::int32_t* biases;
  std::size_t dim;
  std::size_t first_query;
  std::size_t first_row;
};

template <int Queries, int Blocks>
std::size_t scan_tile(const CodeTile& t, Hit* hits) {
  __m512i acc[Queries][Blocks];
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    const __m512i half = _mm512_srai_epi32(_mm512_loadu_si512(t.biases + b * kCodeRows), 1);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = half;
  }
  const std::int8_t* p = t.rows;
  for (std::size_t d = 0; d < t.dim; d += 4, p += 64) {
    __m512i codes[Blocks];
#pragma GCC unroll 8
    for (int b = 0; b < Blocks; ++b) codes[b] = _mm512_loadu_si512(p + b * kCodeRows * t.dim);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      const __m512i query = _mm512_set1_epi32(load4(t.queries + q * t.dim + d));
#pragma GCC unroll 8
      for (int b = 0; b < Blocks; ++b) add_products(acc[q][b], query, codes[b]);
    }
  }
  unsigned any = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    __m512i best = acc[q][0];
#pragma GCC unroll 8
    for (int b = 1; b < Blocks; ++b) best = _mm512_max_epi32(best, acc[q][b]);
    any |= _mm512_cmpge_epi32_mask(best, _mm512_set1_epi32(threshold(t.limits[q])));
  }
  if (any == 0) [[likely]]
    return 0;

  alignas(64) std::int32_t halves[Queries][Blocks][kCodeRows];
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
#pragma GCC unroll 8
    for (int b = 0; b < Blocks; ++b) _mm512_store_si512(halves[q][b], acc[q][b]);
  }
  std::size_t found = 0;
  for (std::size_t q = 0; q < Queries; ++q) {
    for (std::size_t b = 0; b < Blocks; ++b) {
      found += collect_hits(halves[q][b], t.biases + b * kCodeRows, t.limits[q], t.first_query + q,
                            t.first_row + b * kCodeRows, hits + found);
    }
  }
  return found;
}

template <int Blocks>
std::size_t scan_blocks(CodeTile t, std::size_t n, Hit* hits) {
  std::size_t found = 0;
  constexpr int kTile = 4;
  std::size_t q = 0;
  for (; q + kTile <= n; q += kTile) {
    found += scan_tile<kTile, Blocks>(t, hits + found);
    t.queries += kTile * t.dim;
    t.limits += kTile;
    t.first_query += kTile;
  }
  switch (n - q) {
    case 1:
      return found + scan_tile<1, Blocks>(t, hits + found);
    case 2:
      return found + scan_tile<2, Blocks>(t, hits + found);
    case 3:
      return found + scan_tile<3, Blocks>(t, hits + found);
    default:
      return found;
  }
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  std::size_t found = 0;
  std::size_t b = *block;
  while (b < rows.blocks && found < kHitsEnough) {
    const CodeTile tile = {queries.codes,
                           queries.limits,
                           rows.codes + b * kCodeRows * rows.dim,
                           rows.biases + b * kCodeRows,
                           rows.dim,
                           0,
                           b * kCodeRows};
    if (b + 4 <= rows.blocks) {
      found += scan_blocks<4>(tile, queries.n, hits + found);
      b += 4;
    } else {
      found += scan_blocks<1>(tile, queries.n, hits + found);
      b += 1;
    }
  }
  *block = b;
  return found;
}

// `Queries` queries share each load of the rows.
template <int Queries>
std::size_t hamming_tile(const std::uint64_t* queries, const std::int32_t* limits,
                         const std::uint64_t* packed, std::size_t words, std::size_t first_query,
                         std::size_t first_row, Hit* hits) {
  __m512i count[Queries];
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) count[q] = _mm512_setzero_si512();
  for (std::size_t w = 0; w < words; ++w, packed += kWordRows) {
    const __m512i row = _mm512_loadu_si512(packed);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      const __m512i query = _mm512_set1_epi64(static_cast<long long>(queries[q * words + w]));
      count[q] = _mm512_add_epi64(count[q], _mm512_popcnt_epi64(_mm512_xor_si512(query, row)));
    }
  }
  unsigned any = 0;
  __mmask8 hit[Queries];
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    hit[q] = _mm512_cmple_epi64_mask(count[q], _mm512_set1_epi64(limits[q]));
    any |= hit[q];
  }
  if (any == 0) [[likely]]
    return 0;

  std::size_t found = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    alignas(64) std::int64_t distances[kWordRows];
    _mm512_store_si512(distances, count[q]);
    for (unsigned left = hit[q]; left != 0; left &= left - 1) {
      const auto r = static_cast<std::size_t>(__builtin_ctz(left));
      hits[found++] = {static_cast<std::uint32_t>(first_query + q),
                       static_cast<std::uint32_t>(first_row + r),
                       static_cast<std::int32_t>(distances[r])};
    }
  }
  return found;
}

std::size_t hamming_scan(const WordQueries& queries, const PackedWords& rows, std::size_t* block,
                         Hit* hits) {
  constexpr std::size_t kTile = 8;
  const std::size_t words = rows.words;
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kWordRows;
    const std::uint64_t* packed = rows.words_of_rows + row * words;
    std::size_t q = 0;
    for (; q + kTile <= queries.n; q += kTile) {
      found += hamming_tile<kTile>(queries.words + q * words, queries.limits + q, packed, words, q,
                                   row, hits + found);
    }
    for (; q < queries.n; ++q) {
      found += hamming_tile<1>(queries.words + q * words, queries.limits + q, packed, words, q, row,
                               hits + found);
    }
  }
  return found;
}

}  // namespace

const Kernels avx512 = {.name = "avx512",
                        .dense = dense,
                        .code_biases = code_biases,
                        .code_unpack4 = code_unpack4,
                        .code_scan = code_scan,
                        .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
