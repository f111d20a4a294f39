// Queries against packed blocks of int8 codes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/kernels.h"
#include "protomark/search.h"
#include "search/driver.h"
#include "search/packed.h"

namespace protomark {

// Queries as kernels take them: unsigned, padded to whole steps of 4 dimensions.
class PreparedCodes {
 public:
  explicit PreparedCodes(Codes codes);

  std::size_t queries() const { return norms_.size(); }
  std::size_t dim() const { return dim_; }
  const std::uint8_t* operator[](std::size_t query) const { return &codes_[query * dim_]; }
  // Squared norms, which the distances of kernels lack.
  const std::vector<std::int32_t>& norms() const { return norms_; }

  // Places for the k nearest of each query, two if the ratio test needs them.
  Neighbours places(std::size_t k, const SearchOptions& options) const;

 private:
  std::size_t dim_;
  std::vector<std::uint8_t> codes_;
  std::vector<std::int32_t> norms_;
};

// Compares queries with codes. For one thread.
class CodeScan {
 public:
  // Beyond all distances without norms, whose magnitude is below 2^24.
  static constexpr std::int32_t kNoLimit = 1 << 25;

  // Compares queries of this range, which are counted from 0 from here on.
  CodeScan(const PreparedCodes& queries, Range range);

  // Rows to compare with all queries at a time, a multiple of 16. Many queries come back to them
  // from the L2 cache; for few, rows should come from memory while the last ones are compared.
  std::size_t chunk_rows() const;

  // For scans of many rows, of which `met` were compared before: from now on a row is first
  // compared over a prefix of the dimensions. Encoders put those first that tell most, so that the
  // distance over them usually shows that a row is not among the nearest.
  void choose_prefix(std::size_t met);

  // Calls take(query, distance, row) for rows of a packed chunk that are within limit_of(query).
  // Distances are squared and lack the query's norm, which does not change their order.
  template <typename LimitOf, typename Take>
  void compare(const std::int8_t* packed, std::size_t rows, const LimitOf& limit_of,
               const Take& take) {
    compare(all_[range_.begin], range_.size(), packed, rows, limit_of, take);
  }
  // The same for the queries of these indices.
  template <typename LimitOf, typename Take>
  void compare(std::span<const std::uint32_t> queries, const std::int8_t* packed, std::size_t rows,
               const LimitOf& limit_of, const Take& take) {
    gather(queries);
    compare(
        gathered_.data(), queries.size(), packed, rows,
        [&](std::size_t i) { return limit_of(queries[i]); },
        [&](std::size_t i, std::int32_t distance, std::size_t row) {
          take(queries[i], distance, row);
        });
  }

 private:
  template <typename LimitOf, typename Take>
  void compare(const std::uint8_t* codes, std::size_t n, const std::int8_t* packed,
               std::size_t rows, const LimitOf& limit_of, const Take& take) {
    const kernels::PackedCodes chunk = prepare(packed, rows, n);
    each_hit(
        n, rows, chunk.blocks,
        [&](std::size_t first, std::size_t group, const std::int32_t* limits, std::size_t* block,
            kernels::Hit* hits) {
          return kernels::active().code_scan(
              {codes + first * chunk.dim, limits, &rest_norms_[first], group, &steps_in_full_},
              chunk, block, hits);
        },
        limit_of, take);
  }
  void gather(std::span<const std::uint32_t> queries);
  kernels::PackedCodes prepare(const std::int8_t* packed, std::size_t rows, std::size_t n);

  const PreparedCodes& all_;
  Range range_;
  std::vector<std::uint8_t> gathered_;
  std::size_t prefix_;                    // dimensions that are compared first
  std::vector<std::int32_t> rest_norms_;  // see kernels::CodeQueries
  std::size_t steps_in_full_ = 0;
  std::vector<std::int32_t> biases_, prefix_biases_;
};

}  // namespace protomark
