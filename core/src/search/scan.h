// Compares queries with packed prototypes.
#pragma once

#include <cstring>
#include <numeric>

#include "search/driver.h"
#include "search/packed.h"

namespace protomark {

inline int32_t squared_norm(const uint8_t* code, size_t dim) {
  int32_t sum = 0;
  for (size_t d = 0; d < dim; ++d) sum += (code[d] - 128) * (code[d] - 128);
  return sum;
}

static_assert(kPackedRows == kernels::kCodeRows);

// Above all distances without norms, whose magnitude is below 2^24.
inline constexpr int32_t kNoLimit = 1 << 25;

// Queries as kernels take them: unsigned, padded to a multiple of 4 dimensions.
class PreparedCodes {
 public:
  explicit PreparedCodes(Codes codes)
      : dim_(packed_dim(codes.columns)), codes_(codes.rows * dim_, 128) {
    norms_.reserve(codes.rows);
    for (size_t q = 0; q < codes.rows; ++q) {
      for (size_t d = 0; d < codes.columns; ++d) {
        codes_[q * dim_ + d] = static_cast<uint8_t>(codes.row(q)[d] + 128);
      }
      norms_.push_back(squared_norm((*this)[q], dim_));
    }
  }

  size_t queries() const { return norms_.size(); }
  size_t dim() const { return dim_; }
  const uint8_t* operator[](size_t query) const { return codes_.data() + query * dim_; }
  // Squared norms, which the distances that kernels give lack.
  const std::vector<int32_t>& norms() const { return norms_; }

  // Returns room for the k nearest of each query, for two if the ratio test needs them.
  Neighbours neighbours(size_t k, const SearchOptions& options) const {
    std::vector<int32_t> limits(queries(), kNoLimit);
    // The ratio test needs the second nearest at any distance.
    if (options.max_distance && !options.ratio) {
      for (size_t q = 0; q < limits.size(); ++q) {
        limits[q] = std::min(limits[q], *options.max_distance - norms_[q]);
      }
    }
    return {options.ratio ? std::max<size_t>(k, 2) : k, limits};
  }

 private:
  size_t dim_;
  std::vector<uint8_t> codes_;
  std::vector<int32_t> norms_;
};

// Compares queries with codes, on one thread.
class CodeScan {
 public:
  // Compares the queries of this range, whose indices begin with 0 here.
  CodeScan(const PreparedCodes& queries, Range range)
      : all_(queries),
        range_(range),
        codes_(queries[range.begin]),
        n_(range.size()),
        prefix_(queries.dim()),
        rest_norms_(range.size(), 0) {}
  // Compares only these of them from now on.
  void select(std::span<const uint32_t> queries) {
    const size_t dim = all_.dim();
    selected_.resize(queries.size() * dim);
    for (size_t i = 0; i < queries.size(); ++i) {
      std::copy_n(all_[range_.begin + queries[i]], dim, &selected_[i * dim]);
    }
    codes_ = selected_.data();
    n_ = queries.size();
  }

  // Returns how many rows to compare at a time, a multiple of 16: many queries find them in the L2
  // cache; for few, memory should deliver rows while earlier ones are compared.
  size_t chunk_rows() const {
    const auto bytes =
        std::clamp<size_t>(256 * n_, n_ <= kernels::kFewQueries ? 16384 : 8192, 65536);
    return std::max<size_t>(bytes / all_.dim() / kPackedRows, 1) * kPackedRows;
  }

  // Compares later rows first over a prefix of the dimensions, after `met` rows. Encoders put those
  // that tell most first, so that they usually show that a row is not among the nearest.
  void choose_prefix(size_t met) {
    // Few queries wait for memory, which is read as a whole. The more rows were met, the nearer are
    // the neighbours, and the fewer dimensions suffice.
    constexpr size_t kManyRows = size_t{1} << 18;
    if (n_ <= kernels::kFewQueries) return;
    const size_t eighths = met < kManyRows ? 6 : 5;
    const size_t prefix = (all_.dim() * eighths / 8 + 3) / 4 * 4;
    if (prefix == prefix_) return;
    prefix_ = prefix;
    for (size_t q = 0; q < range_.size(); ++q) {
      rest_norms_[q] = squared_norm(all_[range_.begin + q] + prefix, all_.dim() - prefix);
    }
  }

  // Calls take(i, distance, row) for the rows of a packed chunk within limit_of(i) of the i-th
  // query. Distances are squared and lack the query's norm, which does not change their order.
  void compare(const int8_t* packed, size_t rows, const auto& limit_of, const auto& take) {
    const kernels::PackedCodes chunk = prepare(packed, rows);
    each_hit(
        n_, rows, chunk.blocks,
        [&](size_t first, size_t n, const int32_t* limits, size_t* block, kernels::Hit* hits) {
          return kernels::active().code_scan(
              {codes_ + first * chunk.dim, limits, &rest_norms_[first], n, &steps_in_full_}, chunk,
              block, hits);
        },
        limit_of, take);
  }

 private:
  kernels::PackedCodes prepare(const int8_t* packed, size_t rows) {
    const size_t dim = all_.dim(), blocks = packed_blocks(rows);
    if (n_ <= kernels::kFewQueries) return {packed, nullptr, nullptr, blocks, dim, prefix_};
    biases_.resize(std::max(biases_.size(), blocks * kPackedRows));
    prefix_biases_.resize(biases_.size());
    kernels::active().code_biases(packed, blocks, dim, prefix_, biases_.data(),
                                  prefix_biases_.data());
    return {packed, biases_.data(), prefix_biases_.data(), blocks, dim, prefix_};
  }

  const PreparedCodes& all_;
  Range range_;
  const uint8_t* codes_;  // of the queries to compare
  size_t n_;              // their number
  std::vector<uint8_t> selected_;
  size_t prefix_;                    // dimensions that are compared first
  std::vector<int32_t> rest_norms_;  // see kernels::CodeQueries
  size_t steps_in_full_ = 0;
  std::vector<int32_t> biases_, prefix_biases_;
};

// Finds the nearest landmarks of queries, on one thread.
class PrototypeScan {
 public:
  // `nearest` are those of the queries of this range.
  PrototypeScan(const PackedPrototypes& prototypes, const PreparedCodes& queries, Range range,
                Neighbours& nearest)
      : prototypes_(prototypes), scan_(queries, range), nearest_(nearest) {}

  // Compares all queries with consecutive rows; `rows.begin` is a multiple of 16.
  void scan(Range rows) {
    const size_t chunk_rows = scan_.chunk_rows();
    std::vector<uint32_t> blocks;
    for (size_t row = rows.begin; row < rows.end; row += chunk_rows) {
      const size_t n = std::min(chunk_rows, rows.end - row);
      scan_.choose_prefix(row - rows.begin);
      blocks.resize(packed_blocks(n));
      std::iota(blocks.begin(), blocks.end(), static_cast<uint32_t>(row / kPackedRows));
      compare(blocks, n, [](size_t q) { return q; });
    }
  }
  // Compares some queries with the `rows` rows of some blocks, all full but the last.
  void scan(std::span<const uint32_t> queries, std::span<const uint32_t> blocks, size_t rows) {
    constexpr size_t kChunk = 32;
    scan_.select(queries);
    for (size_t first = 0; first < blocks.size(); first += kChunk) {
      const auto chunk = blocks.subspan(first, std::min(kChunk, blocks.size() - first));
      compare(chunk, std::min(chunk.size() * kPackedRows, rows - first * kPackedRows),
              [&](size_t i) { return queries[i]; });
    }
  }

 private:
  // The i-th query that `scan_` compares is query_of(i).
  void compare(std::span<const uint32_t> blocks, size_t rows, const auto& query_of) {
    scan_.compare(
        read(blocks), rows, [&](size_t i) { return nearest_.limit(query_of(i)); },
        [&](size_t i, int32_t distance, size_t at) {
          const size_t row = blocks[at / kPackedRows] * kPackedRows + at % kPackedRows;
          offer(query_of(i), distance, row_at(row));
        });
  }
  // Returns the codes of these blocks, until the next call; decodes words once for all queries.
  const int8_t* read(std::span<const uint32_t> blocks) {
    const auto& [data, rows, dim, width, table, landmarks] = prototypes_;
    const size_t stored_bytes = packed_size(kPackedRows, dim, width);
    const size_t code_bytes = packed_size(kPackedRows, dim);
    for (size_t i = 0, n = 0; i < blocks.size(); i += n) {
      for (n = 1; i + n < blocks.size() && blocks[i + n] == blocks[i] + n;) ++n;
      const uint8_t* stored = static_cast<const uint8_t*>(data) + blocks[i] * stored_bytes;
      if (width == 0 && n == blocks.size()) return reinterpret_cast<const int8_t*>(stored);
      room_.resize(std::max(room_.size(), blocks.size() * code_bytes / sizeof(CodeVector)));
      int8_t* codes = reinterpret_cast<int8_t*>(room_.data()) + i * code_bytes;
      if (width == 0) {
        std::memcpy(codes, stored, n * stored_bytes);
      } else {
        kernels::active().code_decode(stored, n, dim, width, table, codes);
      }
    }
    return reinterpret_cast<const int8_t*>(room_.data());
  }
  // Offers the landmark of a row to a query, unless the row is padding.
  void offer(size_t query, int32_t distance, Row row) {
    const auto& [of_row, look_up, end, ids, among] = prototypes_.landmarks;
    LandmarkIndex landmark{row.value};
    if (of_row != nullptr) {
      landmark = of_row[row.value];
    } else if (look_up) {
      landmark = look_up(row);
    }
    if (landmark >= end || (among != nullptr && !(*among)[landmark.value])) return;
    const int64_t id = ids != nullptr ? ids[landmark.value] : int64_t{landmark.value};
    if (id >= 0) nearest_.offer(query, distance, id, of_row != nullptr || look_up);
  }

  const PackedPrototypes& prototypes_;
  CodeScan scan_;
  Neighbours& nearest_;
  std::vector<CodeVector> room_;
};

inline void scan_all(const PackedPrototypes& prototypes, const PreparedCodes& queries, int threads,
                     Neighbours& nearest) {
  run_search(threads, Division::of_rows(threads, queries.queries(), prototypes.rows),
             prototypes.rows, nearest, [&](Range some, Range rows, Neighbours& part) {
               PrototypeScan(prototypes, queries, some, part).scan(rows);
             });
}

// Answers queries, some at a time, by find(prepared queries, their nearest so far). Throws
// std::invalid_argument if the arguments do not fit prototypes of `dim` numbers.
Matches answer(size_t dim, Codes queries, size_t k, const SearchOptions& options,
               const auto& find) {
  constexpr size_t kAtOnce = 1 << 14;
  require(queries.columns == dim, "queries have ", queries.columns, " dimensions, prototypes ",
          dim);
  require(!options.ratio || (*options.ratio > 0 && *options.ratio <= 1),
          "ratio must be above 0 and at most 1");
  Matches matches = room_for_answer(queries.rows, k, options.max_distance);
  for (size_t first = 0; first < queries.rows; first += kAtOnce) {
    const size_t n = std::min(kAtOnce, queries.rows - first);
    const PreparedCodes prepared({queries.row(first), n, queries.columns});
    Neighbours nearest = prepared.neighbours(k, options);
    find(prepared, nearest);
    write_answer(nearest, prepared.norms(), options, first, matches);
  }
  return matches;
}

// Searches all prototypes (protomark/search.h), whatever options.recall and options.nprobe say.
inline Matches search_exact(const PackedPrototypes& prototypes, Codes queries, size_t k,
                            const SearchOptions& options) {
  return answer(prototypes.dim, queries, k, options, [&](const auto& prepared, auto& nearest) {
    scan_all(prototypes, prepared, options.threads, nearest);
  });
}

}  // namespace protomark
