// AVX-512 with VBMI, VNNI (byte dot products) and VPOPCNTDQ: Ice Lake, Zen 4 and later.
#include <immintrin.h>

#include "avx512_hits.h"
#include "heads.h"
#include "kernels.h"

namespace protomark::kernels {
namespace {

std::int32_t load4(const void* p) {
  std::int32_t v;
  __builtin_memcpy(&v, p, 4);
  return v;
}

// Outputs that are summed together: with a table of 16 KB for 64 inputs, in the L1 cache.
constexpr std::size_t kHalf = kOutputs / 2;

__m512i load_weights(const std::int8_t* weights) {
  return _mm512_cvtepi8_epi16(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(weights)));
}

// The sums of all subsets of 4 inputs, for each 4 of 64 inputs.
void fill_table(const std::int8_t* weights, __m512i* table) {
  for (int group = 0; group < 16; ++group, weights += 4 * kOutputs) {
    const __m512i a = load_weights(weights), b = load_weights(weights + kOutputs);
    const __m512i c = load_weights(weights + 2 * kOutputs);
    const __m512i d = load_weights(weights + 3 * kOutputs);
    const __m512i low[4] = {_mm512_setzero_si512(), a, b, _mm512_add_epi16(a, b)};
    const __m512i high[4] = {_mm512_setzero_si512(), c, d, _mm512_add_epi16(c, d)};
    for (const __m512i h : high) {
      for (const __m512i l : low) *table++ = _mm512_add_epi16(h, l);
    }
  }
}

void bit_sums(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
              std::size_t n, std::int16_t* sums) {
  __m512i table[256];
  for (std::size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (std::size_t half = 0; half < kOutputs; half += kHalf) {
      fill_table(weights + half, table);
      std::int16_t* sum = sums + half;
      for (std::size_t i = 0; i < n; ++i, sum += kOutputs) {
        __m512i acc = w == 0 ? _mm512_setzero_si512() : _mm512_loadu_si512(sum);
        for (int group = 0; group < 16; ++group) {
          acc = _mm512_add_epi16(acc, table[16 * group + (words[i] >> (4 * group) & 15)]);
        }
        _mm512_storeu_si512(sum, acc);
      }
    }
  }
}

void bit_sum(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
             std::int16_t* sums) {
  __m512i low = _mm512_setzero_si512(), high = low;
  for (std::size_t i = 0; i < count; ++i) {
    const std::int8_t* row = weights + set[i] * kOutputs;
    low = _mm512_add_epi16(low, load_weights(row));
    high = _mm512_add_epi16(high, load_weights(row + kHalf));
  }
  _mm512_storeu_si512(sums, low);
  _mm512_storeu_si512(sums + kHalf, high);
}

// `Batch` inputs share each load of the weights, `Groups` times 16 outputs each load of the inputs.
template <int Batch, int Groups>
void dense_tile(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                std::size_t stride, std::int32_t* sums) {
  __m512i acc[Batch][Groups];
  for (auto& row : acc) {
    for (__m512i& a : row) a = _mm512_setzero_si512();
  }
  for (std::size_t j = 0; j < inputs; j += 4) {
    __m512i w[Groups];
    for (int g = 0; g < Groups; ++g) w[g] = _mm512_loadu_si512(weights + 16 * (g * inputs + j));
    for (int i = 0; i < Batch; ++i) {
      const __m512i four = _mm512_set1_epi32(load4(x + i * stride + j));
      for (int g = 0; g < Groups; ++g) acc[i][g] = _mm512_dpbusd_epi32(acc[i][g], four, w[g]);
    }
  }
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < Groups; ++g) _mm512_storeu_si512(sums + i * kOutputs + 16 * g, acc[i][g]);
  }
}

template <int Groups>
void dense_groups(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                  std::size_t stride, std::size_t n, std::int32_t* sums) {
  constexpr int kBatch = 8;
  std::size_t i = 0;
  for (; i + kBatch <= n; i += kBatch) {
    dense_tile<kBatch, Groups>(weights, inputs, x + i * stride, stride, sums + i * kOutputs);
  }
  for (; i < n; ++i) {
    dense_tile<1, Groups>(weights, inputs, x + i * stride, stride, sums + i * kOutputs);
  }
}

void dense(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
           std::size_t stride, std::size_t n, std::size_t outputs, std::int32_t* sums) {
  std::size_t o = 0;
  for (; o + 32 <= outputs; o += 32) {
    dense_groups<2>(weights + o * inputs, inputs, x, stride, n, sums + o);
  }
  if (o < outputs) dense_groups<1>(weights + o * inputs, inputs, x, stride, n, sums + o);
}

__m512i load_sums(const std::int32_t* sums) { return _mm512_loadu_si512(sums); }

__m512i load_sums(const std::int16_t* sums) {
  return _mm512_cvtepi16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(sums)));
}

template <typename Sum>
void activate(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
              std::size_t stride) {
  __m512i bias[4], even[4], odd[4], table[4];
  for (int q = 0; q < 4; ++q) {
    bias[q] = _mm512_loadu_si512(a.bias + 16 * q);
    even[q] = _mm512_loadu_si512(a.multipliers + 16 * q);
    odd[q] = _mm512_srli_epi64(even[q], 32);
    table[q] = _mm512_loadu_si512(a.table + 64 * q);
  }
  const __m512i half = _mm512_set1_epi64(std::int64_t{1} << (a.shift - 1));
  const __m128i shift = _mm_cvtsi32_si128(a.shift - 32);
  // Packing works within each 128 bits.
  const __m512i order = _mm512_set_epi32(15, 11, 7, 3, 14, 10, 6, 2, 13, 9, 5, 1, 12, 8, 4, 0);
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    __m512i t[4];
    for (int q = 0; q < 4; ++q) {
      const __m512i s = _mm512_add_epi32(load_sums(sums + 16 * q), bias[q]);
      const __m512i e = _mm512_add_epi64(_mm512_mul_epi32(s, even[q]), half);
      const __m512i o = _mm512_add_epi64(_mm512_mul_epi32(_mm512_srli_epi64(s, 32), odd[q]), half);
      const __m512i upper = _mm512_mask_shuffle_epi32(o, 0x5555, e, _MM_PERM_DDBB);
      t[q] = _mm512_sra_epi32(upper, shift);
    }
    const __m512i packed = _mm512_permutexvar_epi32(
        order, _mm512_packs_epi16(_mm512_packs_epi32(t[0], t[1]), _mm512_packs_epi32(t[2], t[3])));
    // The lower 7 bits choose in each half of the table, the sign bit the half.
    const __m512i above = _mm512_permutex2var_epi8(table[2], packed, table[3]);
    const __m512i below = _mm512_permutex2var_epi8(table[0], packed, table[1]);
    _mm512_storeu_si512(next, _mm512_mask_mov_epi8(above, _mm512_movepi8_mask(packed), below));
  }
}

// _mm512_dpbusd_epi32 in place: of that, GCC makes two copies of every accumulator a step.
void add_products(__m512i& acc, __m512i u, __m512i s) {
  __asm__("vpdpbusd %2, %1, %0" : "+v"(acc) : "v"(u), "v"(s));
}

// What becomes the biases of 16 rows, -|p|^2 - 256 sum(p), see avx512_hits.h.
class Norms {
 public:
  [[gnu::always_inline]] void add(__m512i p) {
    // p (p + 128): one product of an unsigned and a signed byte in place of p p.
    add_products(products_, _mm512_xor_si512(p, _mm512_set1_epi8(-128)), p);
    add_products(sum_, _mm512_set1_epi8(1), p);
  }
  [[gnu::always_inline]] __m512i biases() const {
    const __m512i offset = _mm512_add_epi32(products_, _mm512_slli_epi32(sum_, 7));
    return _mm512_sub_epi32(_mm512_setzero_si512(), offset);
  }

 private:
  __m512i products_ = _mm512_setzero_si512(), sum_ = _mm512_setzero_si512();
};

void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim, std::size_t head,
                 std::int32_t* biases, std::int32_t* head_biases) {
  for (std::size_t b = 0; b < blocks; ++b) {
    Norms norms;
    std::size_t d = 0;
    for (; d < head; d += 4, packed += 64) norms.add(_mm512_loadu_si512(packed));
    if (head < dim) _mm512_storeu_si512(head_biases + b * kCodeRows, norms.biases());
    for (; d < dim; d += 4, packed += 64) norms.add(_mm512_loadu_si512(packed));
    _mm512_storeu_si512(biases + b * kCodeRows, norms.biases());
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

// Some queries, and rows from one on.
struct CodeTile {
  const std::uint8_t* queries;
  const std::int32_t* limits;
  const std::int32_t* head_limits;
  const std::int8_t* rows;
  const std::int32_t* biases;
  const std::int32_t* head_biases;
  std::size_t dim;
  std::size_t head;
  std::size_t first_query;
  std::size_t first_row;

  CodeTile from_query(std::size_t q) const {
    CodeTile t = *this;
    t.queries += q * dim;
    t.limits += q;
    t.head_limits += q;
    t.first_query += q;
    return t;
  }
};

// Half the negated distances over the first `dims` dimensions, see avx512_hits.h. Inlined, so that
// they stay in registers.
template <int Queries, int Blocks>
[[gnu::always_inline]] inline void sum_up(const CodeTile& t, const std::int32_t* biases,
                                          std::size_t dims, __m512i (&acc)[Queries][Blocks]) {
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    const __m512i half = _mm512_srai_epi32(_mm512_loadu_si512(biases + b * kCodeRows), 1);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = half;
  }
  const std::int8_t* p = t.rows;
  for (std::size_t d = 0; d < dims; d += 4, p += 64) {
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
}

// The same over all dimensions, of rows whose biases are not known: they are found on the way. Rows
// are read in order, which memory is fastest at.
template <int Queries, int Blocks>
[[gnu::always_inline]] inline void sum_up_all(const CodeTile& t, __m512i (&biases)[Blocks],
                                              __m512i (&acc)[Queries][Blocks]) {
  const std::int8_t* p = t.rows;
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    Norms norms;
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = _mm512_setzero_si512();
    for (std::size_t d = 0; d < t.dim; d += 4, p += 64) {
      const __m512i codes = _mm512_loadu_si512(p);
      norms.add(codes);
#pragma GCC unroll 8
      for (int q = 0; q < Queries; ++q) {
        add_products(acc[q][b], _mm512_set1_epi32(load4(t.queries + q * t.dim + d)), codes);
      }
    }
    biases[b] = norms.biases();
    const __m512i half = _mm512_srai_epi32(biases[b], 1);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = _mm512_add_epi32(acc[q][b], half);
  }
}

// Whether one of the rows may be within the limit of a query.
template <int Blocks>
[[gnu::always_inline]] inline unsigned near(const __m512i (&acc)[Blocks], std::int32_t limit) {
  __m512i best = acc[0];
#pragma GCC unroll 8
  for (int b = 1; b < Blocks; ++b) best = _mm512_max_epi32(best, acc[b]);
  return _mm512_cmpge_epi32_mask(best, _mm512_set1_epi32(threshold(limit)));
}

// Under ThreadSanitizer (-O1 -fPIC) g++ 12 mixes up the sums of tiles that are inlined.
#ifdef __SANITIZE_THREAD__
#define PROTOMARK_TILE [[gnu::noinline]]
#else
#define PROTOMARK_TILE
#endif

// The hits of a tile that has some, from half the negated distances.
template <int Queries, int Blocks>
[[gnu::always_inline]] inline std::size_t collect(const CodeTile& t, const std::int32_t* biases,
                                                  const __m512i (&acc)[Queries][Blocks],
                                                  Hit* hits) {
  alignas(64) std::int32_t halves[Queries][Blocks][kCodeRows];
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
#pragma GCC unroll 8
    for (int b = 0; b < Blocks; ++b) _mm512_store_si512(halves[q][b], acc[q][b]);
  }
  std::size_t found = 0;
  for (std::size_t q = 0; q < Queries; ++q) {
    for (std::size_t b = 0; b < Blocks; ++b) {
      found += collect_hits(halves[q][b], biases + b * kCodeRows, t.limits[q], t.first_query + q,
                            t.first_row + b * kCodeRows, hits + found);
    }
  }
  return found;
}

template <int Queries, int Blocks>
PROTOMARK_TILE std::size_t scan_tile(const CodeTile& t, Hit* hits) {
  __m512i acc[Queries][Blocks];
  sum_up(t, t.biases, t.dim, acc);
  unsigned any = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) any |= near(acc[q], t.limits[q]);
  if (any == 0) [[likely]]
    return 0;
  return collect(t, t.biases, acc, hits);
}

// The same without biases: their arithmetic costs few queries less than reading the rows twice.
template <int Queries, int Blocks>
PROTOMARK_TILE std::size_t scan_tile_once(const CodeTile& t, Hit* hits) {
  __m512i acc[Queries][Blocks], biases[Blocks];
  sum_up_all(t, biases, acc);
  unsigned any = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) any |= near(acc[q], t.limits[q]);
  if (any == 0) [[likely]]
    return 0;
  alignas(64) std::int32_t stored[Blocks * kCodeRows];
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) _mm512_store_si512(stored + b * kCodeRows, biases[b]);
  return collect(t, stored, acc, hits);
}

// Calls take<Queries>(tile), so many queries at a time, for all n.
template <typename Take>
void each_tile(const CodeTile& t, std::size_t n, const Take& take) {
  constexpr int kTile = 4;
  std::size_t q = 0;
  for (; q + kTile <= n; q += kTile) take.template operator()<kTile>(t.from_query(q));
  switch (n - q) {
    case 1:
      return take.template operator()<1>(t.from_query(q));
    case 2:
      return take.template operator()<2>(t.from_query(q));
    case 3:
      return take.template operator()<3>(t.from_query(q));
    default:
      return;
  }
}

template <int Blocks>
std::size_t scan_blocks(const CodeTile& all, std::size_t n, Hit* hits) {
  std::size_t found = 0;
  each_tile(all, n, [&]<int Queries>(const CodeTile& t) {
    found += t.biases == nullptr ? scan_tile_once<Queries, Blocks>(t, hits + found)
                                 : scan_tile<Queries, Blocks>(t, hits + found);
  });
  return found;
}

// Blocks that are compared at a time.
constexpr std::size_t kStep = 4;

// The queries that may be within their limits of one of kStep blocks, by their heads.
std::size_t near_by_heads(const CodeTile& all, std::size_t n, std::uint8_t* found) {
  std::size_t size = 0;
  each_tile(all, n, [&]<int Queries>(const CodeTile& t) {
    __m512i acc[Queries][kStep];
    sum_up(t, t.head_biases, t.head, acc);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      // No branch: which ones are near cannot be foretold.
      found[size] = static_cast<std::uint8_t>(t.first_query + static_cast<std::size_t>(q));
      size += near(acc[q], t.head_limits[q]) != 0;
    }
  });
  return size;
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  Heads heads(queries, rows);
  std::size_t found = 0;
  std::size_t b = *block;
  while (b < rows.blocks && found < kHitsEnough) {
    const CodeTile tile = {queries.codes,
                           queries.limits,
                           heads.limits(),
                           rows.codes + b * kCodeRows * rows.dim,
                           rows.biases == nullptr ? nullptr : rows.biases + b * kCodeRows,
                           rows.head_biases + b * kCodeRows,
                           rows.dim,
                           rows.head,
                           0,
                           b * kCodeRows};
    if (b + kStep > rows.blocks) {
      found += scan_blocks<1>(tile, queries.n, hits + found);
      b += 1;
      continue;
    }
    if (heads.now()) {
      std::uint8_t likely[kScanQueries];
      const std::size_t n = near_by_heads(tile, queries.n, likely);
      for (std::size_t i = 0; i < n; ++i) {
        found += scan_tile<1, kStep>(tile.from_query(likely[i]), hits + found);
      }
      heads.left(n);
    } else {
      found += scan_blocks<kStep>(tile, queries.n, hits + found);
    }
    b += kStep;
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
                        .bit_sums = bit_sums,
                        .bit_sum = bit_sum,
                        .dense = dense,
                        .activate16 = activate<std::int16_t>,
                        .activate32 = activate<std::int32_t>,
                        .code_biases = code_biases,
                        .code_unpack4 = code_unpack4,
                        .code_scan = code_scan,
                        .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
