// Queries against packed prototypes, whose rows belong to landmarks.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "protomark/search.h"
#include "search/code_scan.h"
#include "search/packed.h"
#include "search/top_k.h"

namespace protomark {

// Offers landmarks of rows to the places of queries. For one thread.
class LandmarkReader {
 public:
  explicit LandmarkReader(const RowLandmarks& landmarks) : landmarks_(landmarks) {}

  // Rows of this chunk come next. If only numbers of rows are known, chunks must ascend.
  void start_chunk(std::size_t first_row, std::size_t rows) {
    first_row_ = first_row;
    rows_ = rows;
    of_chunk_.clear();
  }

  // Does nothing if the row is padding.
  void offer(TopK best, std::int32_t distance, Row row) {
    const LandmarkIndex landmark = landmark_of(row);
    if (landmark >= landmarks_.end) return;
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
      : rows_(prototypes.rows),
        blocks_(prototypes),
        landmarks_(prototypes.landmarks),
        scan_(queries, range),
        nearest_(nearest) {}

  // Compares all queries with consecutive rows; `rows.begin` is a multiple of 16.
  void scan(Range rows);
  // Compares some queries with the rows of some blocks, `rows` of them: all blocks but the last one
  // are full.
  void scan(std::span<const std::uint32_t> queries, std::span<const std::uint32_t> blocks,
            std::size_t rows);

 private:
  std::size_t rows_;
  BlockReader blocks_;
  LandmarkReader landmarks_;
  CodeScan scan_;
  Neighbours& nearest_;
};

// Finds the nearest landmarks of all prototypes (protomark/search.h). `options` are those of an
// exact search, whatever recall and nprobe say. Throws std::invalid_argument if the arguments do
// not fit.
void search_exact(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
                  MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances);

// Throws std::invalid_argument if the arguments of a search do not fit.
void check_search(std::size_t dim, Codes queries, const SearchOptions& options,
                  const MatrixView<std::int64_t>& ids, const MatrixView<std::int32_t>& distances);

}  // namespace protomark
