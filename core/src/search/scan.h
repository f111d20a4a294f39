// Compares queries with packed prototypes.
#pragma once

#include "search/driver.h"
#include "search/packed.h"

namespace protomark {

// Queries as kernels take them: unsigned, padded to a multiple of 4 dimensions.
class PreparedCodes {
 public:
  explicit PreparedCodes(Codes codes);

  std::size_t queries() const { return norms_.size(); }
  std::size_t dim() const { return dim_; }
  const std::uint8_t* operator[](std::size_t query) const { return codes_.data() + query * dim_; }
  // Squared norms, which the distances that kernels give lack.
  const std::vector<std::int32_t>& norms() const { return norms_; }

  // Returns room for the k nearest of each query, for two if the ratio test needs them.
  Neighbours neighbours(std::size_t k, const SearchOptions& options) const;

 private:
  std::size_t dim_;
  std::vector<std::uint8_t> codes_;
  std::vector<std::int32_t> norms_;
};

// Compares queries with codes, on one thread.
class CodeScan {
 public:
  // Above all distances without norms, whose magnitude is below 2^24.
  static constexpr std::int32_t kNoLimit = 1 << 25;

  // Compares the queries of this range, whose indices begin with 0 here.
  CodeScan(const PreparedCodes& queries, Range range);
  // Compares only these of them from now on.
  void select(std::span<const std::uint32_t> queries);

  // Returns how many rows to compare at a time, a multiple of 16: many queries find them in the L2
  // cache; for few, memory should deliver rows while earlier ones are compared.
  std::size_t chunk_rows() const;

  // Compares later rows first over a prefix of the dimensions, after `met` rows. Encoders put those
  // that tell most first, so that they usually show that a row is not among the nearest.
  void choose_prefix(std::size_t met);

  // Calls take(i, distance, row) for the rows of a packed chunk within limit_of(i) of the i-th
  // query. Distances are squared and lack the query's norm, which does not change their order.
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

// Reads blocks of prototypes as int8 codes, on one thread.
class BlockReader {
 public:
  explicit BlockReader(const PackedPrototypes& prototypes);

  // Returns the codes of these blocks, one after the other, valid until the next call. sq4 numbers
  // are unpacked into the cache, once for all queries.
  const std::int8_t* read(std::size_t first_block, std::size_t n);
  const std::int8_t* read(std::span<const std::uint32_t> blocks);

 private:
  void copy(std::size_t first_block, std::size_t n, std::int8_t* codes) const;
  std::int8_t* room(std::size_t blocks);

  const std::uint8_t* data_;
  std::size_t dim_;
  int scale_;
  std::size_t block_bytes_;  // as stored
  std::size_t code_bytes_;   // of a block as int8 codes
  std::vector<CodeVector> room_;
};

// Finds the nearest landmarks of queries, on one thread.
class PrototypeScan {
 public:
  // `nearest` are those of the queries of this range.
  PrototypeScan(const PackedPrototypes& prototypes, const PreparedCodes& queries, Range range,
                Neighbours& nearest)
      : blocks_(prototypes),
        landmarks_(prototypes.landmarks),
        scan_(queries, range),
        nearest_(nearest) {}

  // Compares all queries with consecutive rows; `rows.begin` is a multiple of 16. With
  // RowLandmarks::row_counts, calls must ascend.
  void scan(Range rows);
  // Compares some queries with the `rows` rows of some blocks, all full but the last.
  void scan(std::span<const std::uint32_t> queries, std::span<const std::uint32_t> blocks,
            std::size_t rows);

 private:
  // Offers the landmark of a row to a query, unless the row is padding.
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
  LandmarkIndex landmark_of(Row row) {
    if (!several_rows_) return {row.value};
    if (landmarks_.of_row != nullptr) return landmarks_.of_row[row.value];
    if (landmarks_.look_up) return landmarks_.look_up(row);
    // Most chunks have no hits and need not be counted.
    if (of_chunk_.empty()) count_chunk();
    return of_chunk_[row.value - chunk_.begin];
  }
  void count_chunk();

  BlockReader blocks_;
  const RowLandmarks& landmarks_;
  CodeScan scan_;
  Neighbours& nearest_;
  bool several_rows_ =
      landmarks_.of_row != nullptr || landmarks_.row_counts != nullptr || landmarks_.look_up;
  // With RowLandmarks::row_counts.
  Range chunk_{};
  std::vector<LandmarkIndex> of_chunk_;  // the landmarks of its rows
  LandmarkIndex landmark_;               // no row of the chunk is of an earlier one
  std::size_t counted_ = 0;              // rows of earlier landmarks
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
