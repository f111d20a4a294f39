// int8 queries against packed blocks of prototypes: what exact search and search by cells share.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/kernels.h"
#include "protomark/search.h"
#include "search/top_k.h"

namespace protomark {

// Codes of 16 rows x 4 dimensions. Aligned: a scan whose loads cross cache lines takes a quarter
// longer.
struct alignas(64) CodeVector {
  std::int8_t codes[4 * kPackedRows];
};

// Throws std::invalid_argument where the arguments of a search in prototypes of `dim` dimensions do
// not fit.
void check_search(std::size_t dim, Codes queries, const SearchOptions& options,
                  const MatrixView<std::int64_t>& ids, const MatrixView<float>& distances);

// Some queries, and the nearest landmarks that each has met so far. For one thread.
class CodeScan {
 public:
  // Keeps k landmarks a query, two where the ratio test needs them. `queries` must outlive this.
  CodeScan(Codes queries, std::size_t k, const SearchOptions& options);
  // Its TopKs point into its own arrays.
  CodeScan(const CodeScan&) = delete;
  CodeScan& operator=(const CodeScan&) = delete;

  std::size_t queries() const { return codes_.rows; }
  // Rows that are compared with all queries at a time, a multiple of 16: what a caller that makes
  // packed blocks as it goes had best make at a time.
  std::size_t chunk_rows() const { return chunk_rows_; }

  // For scans of many rows, of which `met` were compared before: from now on a row is first
  // compared in some dimensions only. Encoders put those first that tell most, so that a distance
  // over them mostly shows that a row is not among the nearest.
  void look_at_heads(std::size_t met);

  // Compares the queries of these indices with the first `rows` rows of `packed`, blocks of 16 rows
  // as in PackedPrototypes, and calls offer(TopK& best, std::int32_t distance, std::size_t row) for
  // those that may be among the k nearest. `offer` calls best.offer(distance, id of the row), or
  // best.offer_distinct where several rows may share an id. `distance` is squared and lacks the
  // query's own norm, which does not change the order.
  template <typename Offer>
  void compare(std::span<const std::uint32_t> queries, const std::int8_t* packed, std::size_t rows,
               const Offer& offer) {
    gather(queries);
    for (std::size_t row = 0; row < rows; row += chunk_rows_) {
      const std::size_t chunk = std::min(chunk_rows_, rows - row);
      start_chunk(packed + packed_size(row, codes_.columns), chunk, queries.size());
      for (std::size_t first = 0; first < queries.size(); first += kernels::kScanQueries) {
        const auto group =
            queries.subspan(first, std::min(kernels::kScanQueries, queries.size() - first));
        for (std::size_t block = 0; block < blocks_;) {
          const std::size_t found = scan_chunk(group, first, &block);
          for (std::size_t i = 0; i < found; ++i) {
            const kernels::Hit& hit = hits_[i];
            // Those before it may have left no room for it.
            if (hit.row >= chunk || hit.distance > limits_[hit.query]) continue;
            TopK& best = best_[group[hit.query]];
            offer(best, hit.distance, row + hit.row);
            limits_[hit.query] = best.limit();
          }
        }
      }
    }
  }

  // Takes what another scan of the same queries has found in other rows.
  void merge(const CodeScan& other);

  // Writes (queries x k) landmarks and distances as protomark::search gives them back.
  void finish(MatrixView<std::int64_t> ids, MatrixView<float> distances) const;

 private:
  void gather(std::span<const std::uint32_t> queries);
  void start_chunk(const std::int8_t* packed, std::size_t rows, std::size_t queries);
  // Hits of gathered queries from `first` on, from a block of the chunk on.
  std::size_t scan_chunk(std::span<const std::uint32_t> group, std::size_t first,
                         std::size_t* block);

  Codes codes_;
  SearchOptions options_;
  std::size_t dim_;   // of packed blocks
  std::size_t kept_;  // landmarks a query
  std::vector<std::uint8_t> unsigned_codes_;
  std::vector<std::int64_t> best_ids_;
  std::vector<std::int32_t> best_distances_;
  std::vector<TopK> best_;
  std::size_t head_;                 // dimensions that are compared first
  std::vector<std::int32_t> tails_;  // squared norm of each query's other dimensions
  std::size_t put_off_ = 0;          // see kernels::CodeQueries

  std::vector<std::uint8_t> gathered_;   // codes of the queries that are compared
  std::size_t chunk_rows_;               // compared with all queries at a time
  const std::int8_t* packed_ = nullptr;  // the chunk
  std::size_t blocks_ = 0;
  bool biased_ = false;  // whether its biases are known
  std::vector<std::int32_t> biases_, head_biases_;
  std::array<std::int32_t, kernels::kScanQueries> limits_;  // of the queries that were scanned last
  std::vector<kernels::Hit> hits_;
};

}  // namespace protomark
