// AVX2: x86 since Haswell and Zen.
#include <immintrin.h>

#include "block_biases.h"
#include "heads.h"
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

// vpmaddubsw saturates, so bytes are widened: 4 dimensions of a row, a 32-bit lane, become 16-bit
// (0, 2) and (1, 3), whose products vpmaddwd sums up within the lane.
__m256i even_dims(__m256i codes) { return _mm256_srai_epi16(_mm256_slli_epi16(codes, 8), 8); }
__m256i odd_dims(__m256i codes) { return _mm256_srai_epi16(codes, 8); }

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
      even[g] = even_dims(w);
      odd[g] = odd_dims(w);
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

__m256i products(__m256i even, __m256i odd, __m256i other_even, __m256i other_odd) {
  return _mm256_add_epi32(_mm256_madd_epi16(even, other_even), _mm256_madd_epi16(odd, other_odd));
}

// |p|^2 + 256 sum(p)
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim, std::size_t head,
                 std::int32_t* biases, std::int32_t* head_biases) {
  const __m256i weight = _mm256_set1_epi16(256);
  for (std::size_t b = 0; b < blocks; ++b, packed += kCodeRows * dim) {
    for (std::size_t half = 0; half < 2; ++half) {
      __m256i sum = _mm256_setzero_si256();
      for (std::size_t d = 0; d < dim; d += 4) {
        if (d == head) store(head_biases + b * kCodeRows + 8 * half, sum);
        const __m256i p = load(packed + d * kCodeRows + 32 * half);
        const __m256i even = even_dims(p), odd = odd_dims(p);
        sum = _mm256_add_epi32(sum, products(even, odd, _mm256_add_epi16(even, weight),
                                             _mm256_add_epi16(odd, weight)));
      }
      store(biases + b * kCodeRows + 8 * half, sum);
    }
  }
}

// 4 dimensions of a query.
struct QueryPairs {
  std::int32_t even;  // two 16-bit numbers
  std::int32_t odd;
};

// Distances over the first `dims` dimensions, whose biases in a block are given. Inlined, so that
// they stay in registers.
template <int Queries>
[[gnu::always_inline]] inline void sum_up(const QueryPairs* queries, const PackedCodes& rows,
                                          std::size_t first_row, const std::int32_t* biases,
                                          std::size_t dims, __m256i (&acc)[Queries][2]) {
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) acc[q][0] = acc[q][1] = _mm256_setzero_si256();
  const std::int8_t* p = rows.codes + first_row * rows.dim;
  const std::size_t steps = rows.dim / 4;
  for (std::size_t s = 0; s < dims / 4; ++s, p += 4 * kCodeRows) {
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
  const __m256i bias[2] = {load(biases), load(biases + 8)};
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    for (int h = 0; h < 2; ++h) {
      acc[q][h] = _mm256_sub_epi32(bias[h], _mm256_slli_epi32(acc[q][h], 1));
    }
  }
}

// All bits where a distance is above the limit.
__m256i both_far(const __m256i (&distances)[2], std::int32_t limit) {
  const __m256i above = _mm256_set1_epi32(limit);
  return _mm256_and_si256(_mm256_cmpgt_epi32(distances[0], above),
                          _mm256_cmpgt_epi32(distances[1], above));
}

template <int Queries>
std::size_t scan_tile(const QueryPairs* queries, const std::int32_t* limits,
                      const PackedCodes& rows, const std::int32_t* biases, std::size_t first_query,
                      std::size_t first_row, Hit* hits) {
  __m256i acc[Queries][2];
  sum_up(queries, rows, first_row, biases, rows.dim, acc);
  __m256i all_far = _mm256_set1_epi32(-1);
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    all_far = _mm256_and_si256(all_far, both_far(acc[q], limits[q]));
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
      store(distances + 8 * h, acc[q][h]);
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

// Appends to `found` which queries from `first_query` on may be within their limits of a block, by
// their heads.
template <int Queries>
std::size_t near_by_heads(const QueryPairs* pairs, const std::int32_t* head_limits,
                          const PackedCodes& rows, std::size_t first_query, std::size_t first_row,
                          std::uint8_t* found) {
  __m256i acc[Queries][2];
  sum_up(pairs, rows, first_row, rows.head_biases + first_row, rows.head, acc);
  std::size_t size = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    // No branch: which ones are near cannot be foretold.
    found[size] = static_cast<std::uint8_t>(first_query + static_cast<std::size_t>(q));
    const __m256i far = both_far(acc[q], head_limits[q]);
    size += _mm256_movemask_epi8(far) != -1;
  }
  return size;
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
  Heads heads(queries, rows);
  std::size_t found = 0;
  BlockBiases biases_of(rows, code_biases);
  const std::int32_t* biases = nullptr;  // of the block
  const auto scan = [&]<int Queries>(std::size_t q, std::size_t row) {
    found += scan_tile<Queries>(pairs + q * steps, queries.limits + q, rows, biases, q, row,
                                hits + found);
  };
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
    biases = biases_of(row);
    std::size_t q = 0;
    if (heads.now()) {
      std::uint8_t likely[kScanQueries];
      std::size_t n = 0;
      for (; q + kTile <= queries.n; q += kTile) {
        n += near_by_heads<kTile>(pairs + q * steps, heads.limits() + q, rows, q, row, likely + n);
      }
      heads.left(n);
      for (std::size_t i = 0; i < n; ++i) scan.template operator()<1>(likely[i], row);
    }
    for (; q + kTile <= queries.n; q += kTile) scan.template operator()<kTile>(q, row);
    for (; q < queries.n; ++q) scan.template operator()<1>(q, row);
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
                      .bit_sums = bit_sums,
                      .bit_sum = bit_sum,
                      .dense = dense,
                      .activate16 = activate<std::int16_t>,
                      .activate32 = activate<std::int32_t>,
                      .code_biases = code_biases,
                      .code_scan = code_scan,
                      .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
