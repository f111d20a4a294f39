// The centroids of inverted lists, learned from the prototypes of a map.
#pragma once

#include "search/packed.h"

namespace protomark {

// The list of a code depends on the code and the centroids alone, so that the lists of a map do not
// depend on its history. Centroids have lists themselves, *groups*: a code's list is that of the
// nearest centroid in the few nearest groups, ties to the smaller, which is almost always the
// nearest of all and takes some hundred comparisons for thousands of lists.
class CoarseQuantizer {
 public:
  static constexpr size_t kMaxLists = 1 << 16;

  CoarseQuantizer() = default;  // without lists
  // `centroids` are (nlist x dim), at least one.
  explicit CoarseQuantizer(Matrix<int8_t> centroids);
  // Learns by Lloyd's k-means, in integers; `nlist` is at most the number of codes.
  static CoarseQuantizer learn(Codes codes, size_t nlist, int threads);
  // Returns a number of lists with which the index takes at most 4 bytes per prototype, both in a
  // learning map, where a row takes `row_bytes`, and in a sealed one.
  static size_t default_nlist(size_t prototypes, size_t dim, size_t row_bytes);
  static constexpr size_t kSampleSize = 48;  // prototypes per list suffice to learn it

  size_t nlist() const { return centroids_.rows; }
  const Matrix<int8_t>& centroids() const { return centroids_; }
  PackedPrototypes packed() const { return packed_view(packed_, nlist()); }

  // Returns the quantizer of the first `dim` numbers of codes, with as many lists.
  CoarseQuantizer cut(size_t dim) const;

  std::vector<uint32_t> assign(Codes codes, int threads) const;

 private:
  PackedPrototypes packed_view(const std::vector<CodeVector>& codes, size_t rows) const {
    return {codes.data(), rows, centroids_.columns};
  }

  Matrix<int8_t> centroids_;
  std::vector<CodeVector> packed_;

  std::vector<CodeVector> group_centroids_;
  std::vector<CodeVector> grouped_;     // centroids by group
  std::vector<LandmarkIndex> list_of_;  // the list of each row of grouped_
  std::vector<uint32_t> group_sizes_;   // of each group
  std::vector<uint32_t> group_blocks_;  // first block of each group, and the end
};

// The new rows of prototypes if lists follow each other, each beginning a new block.
struct ListOrder {
  // `lists` has the list of each row as its value, or kNoRow for padding.
  ListOrder(std::vector<Row> lists, size_t nlist);

  std::vector<uint32_t> sizes;         // of each list
  std::vector<uint32_t> first_blocks;  // of each list, and the end
  std::vector<Row> new_rows;           // of each row
};

}  // namespace protomark
