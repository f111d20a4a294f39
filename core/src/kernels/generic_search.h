// The search kernels, and the table of all kernels, over a set S of vector operations; comments
// with the functions say what S needs. Everything has internal linkage: see kernels.h.
#pragma once

#include "kernels/generic_encoder.h"
#include "kernels/kernels.h"
#include "kernels/vectors.h"

// Under ThreadSanitizer (-O1 -fPIC) g++ 12 mixes up the sums of tiles that are inlined.
#ifdef __SANITIZE_THREAD__
#define PROTOMARK_TILE [[gnu::noinline]]
#else
#define PROTOMARK_TILE
#endif
#define PROTOMARK_INLINE [[gnu::always_inline]] inline

namespace protomark::kernels {
namespace {

// Queries that share each load of the rows.
constexpr int kTileQueries = 4;

// A negated distance is 2 p . q + bias. Sums start from half the bias and end as half the negated
// distance, both rounded down; the lost bit is in the bias. A row whose half is above this
// threshold may be a hit.
int32_t threshold(int32_t limit) { return -((limit >> 1) + (limit & 1)) - 1; }

// Appends the hits among those of a block's 16 rows whose bits are set in `near`.
size_t append_hits(unsigned near, const int32_t* halves, const int32_t* biases, int32_t limit,
                   size_t query, size_t first_row, Hit* hits) {
  size_t found = 0;
  for (; near != 0; near &= near - 1) {
    const auto r = static_cast<size_t>(__builtin_ctz(near));
    const int32_t distance = -2 * halves[r] - (biases[r] & 1);
    if (distance > limit) continue;
    hits[found++] = {static_cast<uint32_t>(query), static_cast<uint32_t>(first_row + r), distance};
  }
  return found;
}

// Queries and rows to compare.
//   S::Step               4 dimensions of a query, as S reads them best
template <typename S>
struct CodeTile {
  const typename S::Step* queries;
  const int32_t* limits;
  const int32_t* thresholds;
  const int32_t* prefix_thresholds;
  PackedCodes rows;  // from first_row on
  size_t first_row;
};

// Computes half the negated distances of the queries from `query` on over the first `dims`
// dimensions. Inlined, so that they stay in registers.
//   S::Sums               16 numbers of 32 bits
//   S::Codes              4 dimensions of 16 rows: load_codes()
//   S::dot(sums, query(step), codes)  adds the products of 4 dimensions
template <typename S, int Queries, int Blocks>
PROTOMARK_INLINE void sum_up(const CodeTile<S>& t, size_t query, const int32_t* biases, size_t dims,
                             typename S::Sums (&acc)[Queries][Blocks]) {
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    const auto half = load_pack<typename S::Sums>(biases + b * kCodeRows) >> 1;
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = half;
  }
  const int8_t* p = t.rows.codes;
  const size_t steps = t.rows.dim / 4;
  const typename S::Step* step = t.queries + query * steps;
  for (size_t s = 0; s < dims / 4; ++s, p += 4 * kCodeRows) {
    typename S::Codes codes[Blocks];
#pragma GCC unroll 8
    for (int b = 0; b < Blocks; ++b) codes[b] = S::load_codes(p + b * kCodeRows * t.rows.dim);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      const auto four = S::query(step[q * steps + s]);
#pragma GCC unroll 8
      for (int b = 0; b < Blocks; ++b) S::dot(acc[q][b], four, codes[b]);
    }
  }
}

// Computes the same over all dimensions, and the biases. Reads rows in order, which memory is
// fastest at.
//   S::Norms              sums for the biases of 16 rows: add(codes), biases()
template <typename S, int Queries, int Blocks>
PROTOMARK_INLINE void sum_up_with_biases(const CodeTile<S>& t, size_t query,
                                         typename S::Sums (&biases)[Blocks],
                                         typename S::Sums (&acc)[Queries][Blocks]) {
  const int8_t* p = t.rows.codes;
  const size_t steps = t.rows.dim / 4;
  const typename S::Step* step = t.queries + query * steps;
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    typename S::Norms norms;
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = {};
    for (size_t s = 0; s < steps; ++s, p += 4 * kCodeRows) {
      const typename S::Codes codes = S::load_codes(p);
      norms.add(codes);
#pragma GCC unroll 8
      for (int q = 0; q < Queries; ++q) {
        S::dot(acc[q][b], S::query(step[q * steps + s]), codes);
      }
    }
    biases[b] = norms.biases();
    const typename S::Sums half = biases[b] >> 1;
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) acc[q][b] = acc[q][b] + half;
  }
}

// Returns whether some blocks may have hits.
//   S::Flags              of above(sums, threshold), joined by |, asked by any()
//   S::max(a, b)          where S compares several blocks at a time
template <typename S, int Blocks>
PROTOMARK_INLINE typename S::Flags near(const typename S::Sums (&acc)[Blocks], int32_t threshold) {
  typename S::Sums best = acc[0];
  if constexpr (Blocks > 1) {
#pragma GCC unroll 8
    for (int b = 1; b < Blocks; ++b) best = S::max(best, acc[b]);
  }
  return S::above(best, threshold);
}

// Appends the hits of a tile.
//   S::near_rows(sums, threshold)  a bit for each row above it
template <typename S, int Queries, int Blocks, bool HasBiases>
PROTOMARK_TILE size_t scan_tile(const CodeTile<S>& t, size_t query, Hit* hits) {
  typename S::Sums acc[Queries][Blocks], own_biases[Blocks];
  if constexpr (HasBiases) {
    sum_up(t, query, t.rows.biases, t.rows.dim, acc);
  } else {
    sum_up_with_biases(t, query, own_biases, acc);
  }
  const int32_t* thresholds = t.thresholds + query;
  typename S::Flags any = near<S>(acc[0], thresholds[0]);
#pragma GCC unroll 8
  for (int q = 1; q < Queries; ++q) any = any | near<S>(acc[q], thresholds[q]);
  if (!S::any(any)) [[likely]]
    return 0;

  alignas(64) int32_t halves[Queries][Blocks][kCodeRows], biases[Blocks][kCodeRows];
#pragma GCC unroll 8
  for (int b = 0; b < Blocks; ++b) {
    if constexpr (HasBiases) {
      own_biases[b] = load_pack<typename S::Sums>(t.rows.biases + b * kCodeRows);
    }
    store_pack(biases[b], own_biases[b]);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) store_pack(halves[q][b], acc[q][b]);
  }
  size_t found = 0;
  for (size_t q = 0; q < Queries; ++q) {
    for (size_t b = 0; b < Blocks; ++b) {
      found += append_hits(S::near_rows(load_pack<typename S::Sums>(halves[q][b]), thresholds[q]),
                           halves[q][b], biases[b], t.limits[query + q], query + q,
                           t.first_row + b * kCodeRows, hits + found);
    }
  }
  return found;
}

// Calls take<Queries>(query) for all n queries, kTileQueries at a time.
void each_tile(size_t n, const auto& take) {
  size_t q = 0;
  for (; q + kTileQueries <= n; q += kTileQueries) take.template operator()<kTileQueries>(q);
  static_assert(kTileQueries == 4);
  if (n - q == 1) take.template operator()<1>(q);
  if (n - q == 2) take.template operator()<2>(q);
  if (n - q == 3) take.template operator()<3>(q);
}

template <typename S, int Blocks>
size_t scan_blocks(const CodeTile<S>& t, size_t n, Hit* hits) {
  size_t found = 0;
  each_tile(n, [&]<int Queries>(size_t query) {
    found += t.rows.biases != nullptr
                 ? scan_tile<S, Queries, Blocks, true>(t, query, hits + found)
                 : scan_tile<S, Queries, Blocks, false>(t, query, hits + found);
  });
  return found;
}

// Lists the queries that may have hits in S::kBlocks blocks, by the prefix.
template <typename S>
size_t near_by_prefix(const CodeTile<S>& t, size_t n, uint8_t* queries) {
  size_t size = 0;
  each_tile(n, [&]<int Queries>(size_t query) {
    typename S::Sums acc[Queries][S::kBlocks];
    sum_up(t, query, t.rows.prefix_biases, t.rows.prefix, acc);
#pragma GCC unroll 8
    for (int q = 0; q < Queries; ++q) {
      // Without a branch, as none could be predicted.
      queries[size] = static_cast<uint8_t>(query + static_cast<size_t>(q));
      size += S::any(near<S>(acc[q], t.prefix_thresholds[query + static_cast<size_t>(q)]));
    }
  });
  return size;
}

//   S::convert(codes, n, steps)  where S::Step is not 4 bytes of the codes
template <typename S>
size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, size_t* block, Hit* hits) {
  // Comparing the prefix of the dimensions first pays if it leaves few queries. If not, some steps
  // are compared in full before it is tried again.
  const bool has_prefix =
      rows.biases != nullptr && rows.prefix < rows.dim && queries.n >= kTileQueries;
  int32_t thresholds[kScanQueries], prefix_thresholds[kScanQueries];
  for (size_t q = 0; q < queries.n; ++q) {
    // |p|^2 - 2 p . q over the other dimensions is at least minus the query's squared norm there.
    const int32_t limit = queries.limits[q], rest = queries.rest_norms[q];
    thresholds[q] = threshold(limit);
    prefix_thresholds[q] = threshold(limit > INT32_MAX - rest ? INT32_MAX : limit + rest);
  }
  [[maybe_unused]] typename S::Step room[kScanQueries * 64];
  CodeTile<S> tile{nullptr, queries.limits, thresholds, prefix_thresholds, rows, 0};
  if constexpr (requires { S::convert(queries.codes, 0, room); }) {
    S::convert(queries.codes, queries.n * rows.dim / 4, room);
    tile.queries = room;
  } else {
    tile.queries = reinterpret_cast<const typename S::Step*>(queries.codes);
  }
  size_t found = 0;
  for (size_t n = 0; *block < rows.blocks && found < kHitsEnough; *block += n) {
    n = *block + S::kBlocks <= rows.blocks ? S::kBlocks : 1;
    tile.first_row = *block * kCodeRows;
    tile.rows.codes = rows.codes + tile.first_row * rows.dim;
    if (rows.biases != nullptr) {
      tile.rows.biases = rows.biases + tile.first_row;
      tile.rows.prefix_biases = rows.prefix_biases + tile.first_row;
    }
    if (n < S::kBlocks) {
      found += scan_blocks<S, 1>(tile, queries.n, hits + found);
    } else if (has_prefix && *queries.steps_in_full == 0) {
      uint8_t near[kScanQueries];
      const size_t left = near_by_prefix(tile, queries.n, near);
      for (size_t i = 0; i < left; ++i) {
        found += scan_tile<S, 1, S::kBlocks, true>(tile, near[i], hits + found);
      }
      if (4 * left > queries.n) *queries.steps_in_full = 15;
    } else {
      if (has_prefix) --*queries.steps_in_full;
      found += scan_blocks<S, S::kBlocks>(tile, queries.n, hits + found);
    }
  }
  return found;
}

template <typename S>
void code_biases(const int8_t* packed, size_t blocks, size_t dim, size_t prefix, int32_t* biases,
                 int32_t* prefix_biases) {
  for (size_t b = 0; b < blocks; ++b) {
    typename S::Norms norms;
    size_t d = 0;
    for (; d < prefix; d += 4, packed += 4 * kCodeRows) norms.add(S::load_codes(packed));
    if (prefix < dim) store_pack(prefix_biases + b * kCodeRows, norms.biases());
    for (; d < dim; d += 4, packed += 4 * kCodeRows) norms.add(S::load_codes(packed));
    store_pack(biases + b * kCodeRows, norms.biases());
  }
}

template <typename S>
void nearest_words(const int8_t* words, const int32_t* keys, const uint8_t* numbers, size_t n,
                   uint8_t* nearest) {
  constexpr int kVectors = static_cast<int>(64 / sizeof(S::Sums::v[0]));
  using Ints = Vector<int32_t, sizeof(S::Sums::v[0])>;
  for (size_t i = 0; i < n; ++i, numbers += 4) {
    const auto four = S::query(numbers);
    // Negated distances, and then what makes the first of equals the largest.
    Ints best[kVectors];
    for (Ints& v : best) v = Ints{} + INT32_MIN;
    for (size_t row = 0; row < 256; row += kCodeRows) {
      typename S::Sums sums{};
      S::dot(sums, four, S::load_codes(words + 4 * row));
      for (int v = 0; v < kVectors; ++v) {
        const Ints key = ((Ints)sums.v[v] << 9) + load<Ints>(keys + row + v * kCodeRows / kVectors);
        best[v] = key > best[v] ? key : best[v];
      }
    }
    int32_t largest = INT32_MIN;
    for (const Ints& v : best) {
      for (size_t lane = 0; lane < kCodeRows / kVectors; ++lane) {
        largest = v[lane] > largest ? v[lane] : largest;
      }
    }
    nearest[i] = static_cast<uint8_t>(255 - (largest & 255));
  }
}

// The words of 4 numbers in consecutive blocks, `words_block` bytes apart.
struct WordsOf4 {
  const uint8_t* of_number[4];
  size_t words_block;
};

//   S::decode(words, blocks, table, codes, codes_block)  where S has something faster, for up to
//                         S::kDecodeBlocks blocks
template <typename S>
void code_decode(const uint8_t* packed, size_t blocks, size_t dim, size_t width,
                 const int8_t* table, int8_t* codes) {
  constexpr bool kFaster = requires { S::kDecodeBlocks; };
  WordsOf4 words{{}, dim / width * kCodeRows};
  const size_t codes_block = (dim + 3) / 4 * 4 * kCodeRows;
  size_t n = 1;
  for (size_t b = 0; b < blocks; b += n, packed += n * words.words_block) {
    if constexpr (kFaster) n = blocks - b < S::kDecodeBlocks ? blocks - b : S::kDecodeBlocks;
    int8_t* to = codes + b * codes_block;
    for (size_t d = 0; d < dim; d += 4, to += 4 * kCodeRows) {
      for (size_t j = 0; j < 4; ++j) {
        // Numbers that there are not are zeros by any word.
        words.of_number[j] = packed + (d + j < dim ? d + j : dim - 1) / width * kCodeRows;
      }
      const int8_t* numbers = table + 256 * d;
      if constexpr (kFaster) {
        S::decode(words, n, numbers, to, codes_block);
      } else {
        const auto* values = reinterpret_cast<const uint8_t*>(numbers);
        for (size_t r = 0; r < kCodeRows; ++r) {
          const auto value = [&](size_t j) {
            return uint32_t{values[256 * j + words.of_number[j][r]]};
          };
          store(to + 4 * r, value(0) | value(1) << 8 | value(2) << 16 | value(3) << 24);
        }
      }
    }
  }
}

// `Queries` queries share each load of the rows.
//   S::Words              8 numbers of 64 bits, one of each row: add_bits(counts, query, words);
//                         near_words(counts, limit) has a bit for each row within the limit
//   S::BitCounts          where S counts S::kByteWords words in bytes first: add_bits() adds to
//                         these, add_counts(counts, bytes) adds them up
template <typename S, int Queries>
size_t hamming_tile(const uint64_t* queries, const int32_t* limits, const uint64_t* packed,
                    size_t words, size_t first_query, size_t first_row, Hit* hits) {
  const auto count = [&](size_t w, size_t end, auto& sums) {
    for (; w < end; ++w, packed += kWordRows) {
      const auto row = load_pack<typename S::Words>(packed);
#pragma GCC unroll 8
      for (int q = 0; q < Queries; ++q) S::add_bits(sums[q], queries[q * words + w], row);
    }
  };
  typename S::Words counts[Queries] = {};
  if constexpr (!requires { typename S::BitCounts; }) {
    count(0, words, counts);
  } else {
    for (size_t w = 0; w < words; w += S::kByteWords) {
      typename S::BitCounts bytes[Queries] = {};
      count(w, words - w < S::kByteWords ? words : w + S::kByteWords, bytes);
#pragma GCC unroll 8
      for (int q = 0; q < Queries; ++q) S::add_counts(counts[q], bytes[q]);
    }
  }
  unsigned near[Queries], any = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    near[q] = S::near_words(counts[q], limits[q]);
    any |= near[q];
  }
  if (any == 0) [[likely]]
    return 0;

  size_t found = 0;
#pragma GCC unroll 8
  for (int q = 0; q < Queries; ++q) {
    alignas(64) int64_t distances[kWordRows];
    store_pack(distances, counts[q]);
    for (; near[q] != 0; near[q] &= near[q] - 1) {
      const auto r = static_cast<size_t>(__builtin_ctz(near[q]));
      hits[found++] = {static_cast<uint32_t>(first_query + static_cast<size_t>(q)),
                       static_cast<uint32_t>(first_row + r), static_cast<int32_t>(distances[r])};
    }
  }
  return found;
}

template <typename S>
size_t hamming_scan(const WordQueries& queries, const PackedWords& rows, size_t* block, Hit* hits) {
  const size_t words = rows.words;
  size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const size_t row = *block * kWordRows;
    const auto scan = [&]<int Queries>(size_t q) {
      found +=
          hamming_tile<S, Queries>(queries.words + q * words, queries.limits + q,
                                   rows.words_of_rows + row * words, words, q, row, hits + found);
    };
    size_t q = 0;
    for (; q + S::kWordQueries <= queries.n; q += S::kWordQueries) {
      scan.template operator()<S::kWordQueries>(q);
    }
    for (; q < queries.n; ++q) scan.template operator()<1>(q);
  }
  return found;
}

template <typename S>
constexpr Kernels kernels_of(const char* name) {
  return {.name = name,
          .bit_sums = bit_sums<S>,
          .bit_sum = bit_sum<S>,
          .dense = dense<S>,
          .activate16 = activation_of<S, int16_t>(),
          .activate32 = activation_of<S, int32_t>(),
          .code_biases = code_biases<S>,
          .code_decode = code_decode<S>,
          .nearest_words = nearest_words<S>,
          .code_scan = code_scan<S>,
          .hamming_scan = hamming_scan<S>};
}

}  // namespace
}  // namespace protomark::kernels
