// int8 queries against packed blocks of prototypes: what exact search and search by cells share.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "protomark/search.h"
#include "top_k.h"

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

  // Compares the queries of these indices with the first `rows` rows of `packed`, blocks of 16 rows
  // as in PackedPrototypes, and calls offer(TopK& best, std::int32_t distance, std::size_t row) for
  // those that may be among the k nearest. `offer` calls best.offer(distance, id of the row), or
  // best.offer_distinct where several rows may share an id. `distance` is squared and lacks the
  // query's own norm, which does not change the order.
  template <typename Offer>
  void compare(std::span<const std::uint32_t> queries, const std::int8_t* packed, std::size_t rows,
               const Offer& offer) {
    for (std::size_t row = 0; row < rows; row += kChunkRows) {
      const std::size_t chunk_rows = std::min(kChunkRows, rows - row);
      start_chunk(packed + packed_size(row, codes_.columns), chunk_rows);
      for (const std::uint32_t query : queries) {
        const std::size_t found = scan_chunk(query);
        for (std::size_t i = 0; i < found; ++i) {
          if (hit_rows_[i] < chunk_rows) offer(best_[query], hit_distances_[i], row + hit_rows_[i]);
        }
      }
    }
  }

  // Takes over what another scan of the same queries has met.
  void merge(const CodeScan& other);

  // Writes (queries x k) landmarks and distances as protomark::search gives them back.
  void finish(MatrixView<std::int64_t> ids, MatrixView<float> distances) const;

 private:
  // Rows that are compared with all queries at a time; they stay in the L1 cache (32 dimensions).
  static constexpr std::size_t kChunkRows = 32 * kPackedRows;

  void start_chunk(const std::int8_t* packed, std::size_t rows);
  std::size_t scan_chunk(std::uint32_t query);

  Codes codes_;
  SearchOptions options_;
  std::size_t dim_;   // of packed blocks
  std::size_t kept_;  // landmarks a query
  std::vector<std::uint8_t> unsigned_codes_;
  std::vector<std::int64_t> best_ids_;
  std::vector<std::int32_t> best_distances_;
  std::vector<TopK> best_;

  const std::int8_t* packed_ = nullptr;  // the chunk
  std::size_t blocks_ = 0;
  std::vector<std::int32_t> offsets_;
  std::vector<std::uint32_t> hit_rows_;
  std::vector<std::int32_t> hit_distances_;
};

}  // namespace protomark
