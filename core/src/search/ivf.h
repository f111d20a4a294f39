// Coarse cells in the space of codes, learned from the prototypes of a map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "protomark/search.h"
#include "search/scan.h"

namespace protomark {

// Codes as PackedPrototypes has them.
std::vector<CodeVector> pack_codes(Codes codes);

// A code's cell depends on the code and the centroids alone, so that a map's cells do not depend on
// its history. Centroids have cells themselves, *groups*: a code's cell is that of the nearest
// centroid in the few nearest groups, ties to the smaller, which is almost always the nearest of
// all and takes some hundreds of comparisons for thousands of cells.
class Cells {
 public:
  static constexpr std::size_t kMaxCells = 1 << 16;

  // None.
  Cells() = default;
  // Cells of these centroids, (cells x dim), at least one.
  Cells(std::vector<std::int8_t> centroids, std::size_t dim);
  // As many cells by Lloyd's k-means, in integers; at most as many as codes.
  static Cells learn(Codes codes, std::size_t cells, int threads);
  // Where the caller names no number: cells for that many prototypes, few enough that the index of
  // an open map, in which a place takes `place` bytes, and that of a sealed one take at most 4
  // bytes for each of them.
  static std::size_t number_for(std::size_t prototypes, std::size_t dim, std::size_t place);
  // Prototypes that suffice to learn as many cells.
  static std::size_t sample_for(std::size_t cells) { return 48 * cells; }

  std::size_t size() const { return dim_ == 0 ? 0 : centroids_.size() / dim_; }
  // (cells x dim)
  const std::vector<std::int8_t>& centroids() const { return centroids_; }
  PackedPrototypes packed() const { return packed_.view(size(), dim_); }

  // The cell of each code.
  std::vector<std::uint32_t> assign(Codes codes, int threads) const;

 private:
  struct Packed {
    std::vector<CodeVector> codes;
    PackedPrototypes view(std::size_t rows, std::size_t dim) const {
      return {reinterpret_cast<const std::int8_t*>(codes.data()), rows, dim};
    }
  };

  std::size_t dim_ = 0;
  std::vector<std::int8_t> centroids_;
  Packed packed_;

  Packed group_centroids_;
  Packed grouped_;                           // centroids by group
  std::vector<std::uint32_t> cell_of_;       // of each place in grouped_
  std::vector<std::uint32_t> group_sizes_;   // of each group
  std::vector<std::uint32_t> group_blocks_;  // first block of each group, and the end
};

// Where rows stand when cells follow each other, each from a new block on, rows in the order in
// which they come. A row of cell kNone is none, and stands nowhere: kNone.
struct CellOrder {
  static constexpr std::uint32_t kNone = UINT32_MAX;

  CellOrder(std::vector<std::uint32_t> cell_of_row, std::size_t cells);

  std::vector<std::uint32_t> rows;          // of each cell
  std::vector<std::uint32_t> first_blocks;  // of each cell, and the end
  std::vector<std::uint32_t> places;        // of each row
};

}  // namespace protomark
