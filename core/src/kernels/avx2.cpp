// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "kernels.h"

namespace protomark::kernels {
namespace {

// vpmaddubsw saturates, so bytes are widened: 4 dimensions of a row, a 32-bit lane, become 16-bit
// (0, 2) and (1, 3), whose products vpmaddwd sums up within the lane.
__m256i even_dims(__m256i codes) { return _mm256_srai_epi16(_mm256_slli_epi16(codes, 8), 8); }
__m256i odd_dims(__m256i codes) { return _mm256_srai_epi16(codes, 8); }

__m256i load(const void* p) { return _mm256_loadu_si256(static_cast<const __m256i*>(p)); }

__m256i products(__m256i even, __m256i odd, __m256i other_even, __m256i other_odd) {
  return _mm256_add_epi32(_mm256_madd_epi16(even, other_even), _mm256_madd_epi16(odd, other_odd));
}

// |p|^2 + 256 sum(p)
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                 std::int32_t* biases) {
  const __m256i weight = _mm256_set1_epi16(256);
  for (std::size_t b = 0; b < blocks; ++b, packed += kCodeRows * dim) {
    for (std::size_t half = 0; half < 2; ++half) {
      __m256i sum = _mm256_setzero_si256();
      for (std::size_t d = 0; d < dim; d += 4) {
        const __m256i p = load(packed + d * kCodeRows + 32 * half);
        const __m256i even = even_dims(p), odd = odd_dims(p);
        sum = _mm256_add_epi32(sum, products(even, odd, _mm256_add_epi16(even, weight),
                                             _mm256_add_epi16(odd, weight)));
      }
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(biases + b * kCodeRows + 8 * half), sum);
    }
  }
}

// 4 dimensions of a query.
struct QueryPairs {
  std::int32_t even;  // two 16-bit numbers
  std::int32_t odd;
};

template <int Queries>
std::size_t scan_tile(const QueryPairs* queries, const std::int32_t* limits,
                      const PackedCodes& rows, std::size_t first_query, std::size_t first_row,
                      Hit* hits) {
  __m256i acc[Queries][2];
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) acc[q][0] = acc[q][1] = _mm256_setzero_si256();
  const std::int8_t* p = rows.codes + first_row * rows.dim;
  const std::size_t steps = rows.dim / 4;
  for (std::size_t s = 0; s < steps; ++s, p += 4 * kCodeRows) {
    const __m256i first = load(p), second = load(p + 32);
    const __m256i even[2] = {even_dims(first), even_dims(second)};
    const __m256i odd[2] = {odd_dims(first), odd_dims(second)};
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      const __m256i query_even = _mm256_set1_epi32(queries[q * steps + s].even);
      const __m256i query_odd = _mm256_set1_epi32(queries[q * steps + s].odd);
      for (int h = 0; h < 2; ++h) {
        acc[q][h] = _mm256_add_epi32(acc[q][h], products(even[h], odd[h], query_even, query_odd));
      }
    }
  }
  const std::int32_t* biases = rows.biases + first_row;
  const __m256i bias[2] = {load(biases), load(biases + 8)};
  __m256i all_far = _mm256_set1_epi32(-1);
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    const __m256i limit = _mm256_set1_epi32(limits[q]);
    for (int h = 0; h < 2; ++h) {
      acc[q][h] = _mm256_sub_epi32(bias[h], _mm256_slli_epi32(acc[q][h], 1));
      all_far = _mm256_and_si256(all_far, _mm256_cmpgt_epi32(acc[q][h], limit));
    }
  }
  if (_mm256_movemask_epi8(all_far) == -1) [[likely]]
    return 0;

  std::size_t found = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    std::int32_t distances[kCodeRows];
    const __m256i limit = _mm256_set1_epi32(limits[q]);
    unsigned near = 0;
    for (int h = 0; h < 2; ++h) {
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(distances + 8 * h), acc[q][h]);
      const __m256i far = _mm256_cmpgt_epi32(acc[q][h], limit);
      near |= (~static_cast<unsigned>(_mm256_movemask_ps(_mm256_castsi256_ps(far))) & 0xff)
              << (8 * h);
    }
    for (; near != 0; near &= near - 1) {
      const auto r = static_cast<std::size_t>(__builtin_ctz(near));
      hits[found++] = {static_cast<std::uint32_t>(first_query + q),
                       static_cast<std::uint32_t>(first_row + r), distances[r]};
    }
  }
  return found;
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  constexpr std::size_t kTile = 4;
  const std::size_t steps = rows.dim / 4;
  QueryPairs pairs[kScanQueries * 64];
  for (std::size_t i = 0; i < queries.n * steps; ++i) {
    const std::uint8_t* u = queries.codes + 4 * i;
    pairs[i] = {u[0] | u[2] << 16, u[1] | u[3] << 16};
  }
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
    std::size_t q = 0;
    for (; q + kTile <= queries.n; q += kTile) {
      found += scan_tile<kTile>(pairs + q * steps, queries.limits + q, rows, q, row, hits + found);
    }
    for (; q < queries.n; ++q) {
      found += scan_tile<1>(pairs + q * steps, queries.limits + q, rows, q, row, hits + found);
    }
  }
  return found;
}

// Bits in each byte.
__m256i popcount_bytes(__m256i x) {
  const __m256i table = _mm256_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4,  //
                                         0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
  const __m256i nibble = _mm256_set1_epi8(15);
  const __m256i low = _mm256_and_si256(x, nibble);
  const __m256i high = _mm256_and_si256(_mm256_srli_epi16(x, 4), nibble);
  return _mm256_add_epi8(_mm256_shuffle_epi8(table, low), _mm256_shuffle_epi8(table, high));
}

template <int Queries>
std::size_t hamming_tile(const std::uint64_t* queries, const std::int32_t* limits,
                         const PackedWords& rows, std::size_t first_query, std::size_t first_row,
                         Hit* hits) {
  constexpr std::size_t kByteWords = 31;  // 31 * 8 bits are counted in a byte
  const __m256i zero = _mm256_setzero_si256();
  const std::size_t words = rows.words;
  const std::uint64_t* packed = rows.words_of_rows + first_row * words;
  __m256i count[Queries][2];
  for (int q = 0; q < Queries; ++q) count[q][0] = count[q][1] = zero;
  for (std::size_t w = 0; w < words;) {
    __m256i bytes[Queries][2];
    for (int q = 0; q < Queries; ++q) bytes[q][0] = bytes[q][1] = zero;
    const std::size_t end = words - w < kByteWords ? words : w + kByteWords;
    for (; w < end; ++w, packed += kWordRows) {
      const __m256i row[2] = {load(packed), load(packed + 4)};
#pragma GCC unroll 8
      for (int q = 0; q < Queries; ++q) {
        const __m256i query = _mm256_set1_epi64x(static_cast<long long>(queries[q * words + w]));
        for (int h = 0; h < 2; ++h) {
          bytes[q][h] =
              _mm256_add_epi8(bytes[q][h], popcount_bytes(_mm256_xor_si256(query, row[h])));
        }
      }
    }
    for (int q = 0; q < Queries; ++q) {
      for (int h = 0; h < 2; ++h) {
        count[q][h] = _mm256_add_epi64(count[q][h], _mm256_sad_epu8(bytes[q][h], zero));
      }
    }
  }
  std::size_t found = 0;
  for (int q = 0; q < Queries; ++q) {
    const __m256i limit = _mm256_set1_epi64x(limits[q]);
    for (int h = 0; h < 2; ++h) {
      const __m256i far = _mm256_cmpgt_epi64(count[q][h], limit);
      unsigned near = ~static_cast<unsigned>(_mm256_movemask_pd(_mm256_castsi256_pd(far))) & 15;
      if (near == 0) [[likely]]
        continue;
      std::int64_t distances[4];
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(distances), count[q][h]);
      for (; near != 0; near &= near - 1) {
        const auto r = static_cast<std::size_t>(__builtin_ctz(near));
        hits[found++] = {static_cast<std::uint32_t>(first_query + q),
                         static_cast<std::uint32_t>(first_row + 4 * h + r),
                         static_cast<std::int32_t>(distances[r])};
      }
    }
  }
  return found;
}

std::size_t hamming_scan(const WordQueries& queries, const PackedWords& rows, std::size_t* block,
                         Hit* hits) {
  constexpr std::size_t kTile = 2;
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kWordRows;
    std::size_t q = 0;
    for (; q + kTile <= queries.n; q += kTile) {
      found += hamming_tile<kTile>(queries.words + q * rows.words, queries.limits + q, rows, q, row,
                                   hits + found);
    }
    for (; q < queries.n; ++q) {
      found += hamming_tile<1>(queries.words + q * rows.words, queries.limits + q, rows, q, row,
                               hits + found);
    }
  }
  return found;
}

}  // namespace

const Kernels avx2 = {.name = "avx2",
                      .code_biases = code_biases,
                      .code_scan = code_scan,
                      .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
