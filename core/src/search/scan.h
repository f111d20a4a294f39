// Queries against packed prototypes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/kernels.h"
#include "protomark/search.h"
#include "search/driver.h"
#include "search/packed.h"
#include "search/top_k.h"

namespace protomark {

// Queries as kernels take them: unsigned, padded to whole steps of 4 dimensions.
class PreparedCodes {
 public:
  explicit PreparedCodes(Codes codes);

  std::size_t queries() const { return norms_.size(); }
  std::size_t dim() const { return dim_; }
  const std::uint8_t* operator[](std::size_t query) const { return codes_.data() + query * dim_; }
  // Squared norms, which the distances of kernels lack.
  const std::vector<std::int32_t>& norms() const { return norms_; }

  // Returns room for the k nearest of each query, for two if the ratio test needs them.
  Neighbours neighbours(std::size_t k, const SearchOptions& options) const;

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

  // Compares the queries of this range, which are counted from 0 from here on.
  CodeScan(const PreparedCodes& queries, Range range);
  // Compares only these from now on.
  void select(std::span<const std::uint32_t> queries);

  // Rows to compare at a time, a multiple of 16. Many queries come back to them from the L2 cache;
  // for few, rows should come from memory while the last ones are compared.
  std::size_t chunk_rows() const;

  // For scans of many rows, of which `met` were compared before: from now on a row is first
  // compared over a prefix of the dimensions. Encoders put those first that tell most, so that the
  // distance over them usually shows that a row is not among the nearest.
  void choose_prefix(std::size_t met);

  // Calls take(i, distance, row) for rows of a packed chunk that are within limit_of(i), for the
  // i-th of the queries. Distances are squared and lack the query's norm, which does not change
  // their order.
  template <typename LimitOf, typename Take>
  void compare(const std::int8_t* packed, std::size_t rows, const LimitOf& limit_of,
               const Take& take) {
    const kernels::PackedCodes chunk = prepare(packed, rows);
    each_hit(
        n_, rows, chunk.blocks,
        [&](std::size_t first, std::size_t n, const std::int32_t* limits, std::size_t* block,
            kernels::Hit* hits) {
          return kernels::active().code_scan(
              {codes_ + first * chunk.dim, limits, &rest_norms_[first], n, &steps_in_full_}, chunk,
              block, hits);
        },
        limit_of, take);
  }

 private:
  kernels::PackedCodes prepare(const std::int8_t* packed, std::size_t rows);

  const PreparedCodes& all_;
  Range range_;
  const std::uint8_t* codes_;  // of the queries to compare
  std::size_t n_;              // their number
  std::vector<std::uint8_t> selected_;
  std::size_t prefix_;                    // dimensions that are compared first
  std::vector<std::int32_t> rest_norms_;  // see kernels::CodeQueries
  std::size_t steps_in_full_ = 0;
  std::vector<std::int32_t> biases_, prefix_biases_;
};

// Offers the landmarks of rows to the places of queries. For one thread.
class LandmarkReader {
 public:
  explicit LandmarkReader(const RowLandmarks& landmarks) : landmarks_(landmarks) {}

  // Announces the rows that come next. With RowLandmarks::row_counts, chunks must ascend.
  void start_chunk(std::size_t first_row, std::size_t rows) {
    first_row_ = first_row;
    rows_ = rows;
    of_chunk_.clear();
  }

  // Does nothing if the row is padding or its landmark not searched.
  void offer(TopK best, std::int32_t distance, Row row) {
    const LandmarkIndex landmark = landmark_of(row);
    if (landmark >= landmarks_.end) return;
    if (landmarks_.among != nullptr && !(*landmarks_.among)[landmark.value]) return;
    const std::int64_t id =
        landmarks_.ids != nullptr ? landmarks_.ids[landmark.value] : std::int64_t{landmark.value};
    if (id < 0) return;
    if (several_rows_) {
      best.offer_distinct(distance, id);
    } else {
      best.offer(distance, id);
    }
  }

 private:
  LandmarkIndex landmark_of(Row row) {
    if (!several_rows_) return {row.value};
    if (landmarks_.of_row != nullptr) return landmarks_.of_row[row.value];
    if (landmarks_.look_up) return landmarks_.look_up(row);
    // Once neighbours are near, most chunks have no hits and need not be counted.
    if (of_chunk_.empty()) count_chunk();
    return of_chunk_[row.value - first_row_];
  }

  void count_chunk() {
    const std::uint8_t* counts = landmarks_.row_counts;
    while (counted_ + counts[landmark_.value] <= first_row_) counted_ += counts[landmark_.value++];
    LandmarkIndex landmark = landmark_;
    std::size_t end = counted_ + counts[landmark.value];
    for (std::size_t row = first_row_; row < first_row_ + rows_; ++row) {
      if (row == end) end += counts[++landmark.value];
      of_chunk_.push_back(landmark);
    }
  }

  const RowLandmarks& landmarks_;
  bool several_rows_ =
      landmarks_.of_row != nullptr || landmarks_.row_counts != nullptr || landmarks_.look_up;
  std::size_t first_row_ = 0;
  std::size_t rows_ = 0;
  std::vector<LandmarkIndex> of_chunk_;
  LandmarkIndex landmark_;   // no row of the chunk is of an earlier one
  std::size_t counted_ = 0;  // rows of earlier landmarks
};

// Keeps the nearest landmarks of queries. For one thread.
class PrototypeScan {
 public:
  // Neighbours of the queries of this range.
  PrototypeScan(const PackedPrototypes& prototypes, const PreparedCodes& queries, Range range,
                Neighbours& nearest)
      : blocks_(prototypes),
        landmarks_(prototypes.landmarks),
        scan_(queries, range),
        nearest_(nearest) {}

  // Compares all queries with consecutive rows; `rows.begin` is a multiple of 16.
  void scan(Range rows);
  // Compares some queries with the `rows` rows of some blocks, all of them full but the last.
  void scan(std::span<const std::uint32_t> queries, std::span<const std::uint32_t> blocks,
            std::size_t rows);

 private:
  BlockReader blocks_;
  LandmarkReader landmarks_;
  CodeScan scan_;
  Neighbours& nearest_;
};

// Compares all queries with all prototypes.
void scan_all(const PackedPrototypes& prototypes, const PreparedCodes& queries, int threads,
              Neighbours& nearest);

// Finds the nearest landmarks among all prototypes (protomark/search.h), whatever options.recall
// and options.nprobe say. Throws std::invalid_argument if the arguments do not fit.
Matches search_exact(const PackedPrototypes& prototypes, Codes queries, std::size_t k,
                     const SearchOptions& options);

// Returns room for the answer of a search. Throws std::invalid_argument if its arguments do not
// fit.
Matches check_search(std::size_t dim, Codes queries, std::size_t k, const SearchOptions& options);

}  // namespace protomark
