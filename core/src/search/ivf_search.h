// Search in the cells of a map whose centroids are nearest to a query.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "protomark/search.h"
#include "search/cell_blocks.h"

namespace protomark {

// The blocks of each cell: chained in an open map, one after the other elsewhere.
class CellView {
 public:
  explicit CellView(const CellBlocks& chained) : chained_(&chained) {}
  // `first_blocks` has one more, the number of all blocks.
  CellView(std::span<const std::uint32_t> rows, std::span<const std::uint32_t> first_blocks)
      : rows_(rows), first_blocks_(first_blocks) {}

  std::size_t cells() const { return chained_ != nullptr ? chained_->cells() : rows_.size(); }
  std::size_t rows(std::uint32_t cell) const {
    return chained_ != nullptr ? chained_->rows(cell) : rows_[cell];
  }
  // The blocks of a cell, in order; all are full but the last one.
  void list(std::uint32_t cell, std::vector<std::uint32_t>& blocks) const;

 private:
  const CellBlocks* chained_ = nullptr;
  std::span<const std::uint32_t> rows_;
  std::span<const std::uint32_t> first_blocks_;
};

// As search of protomark/search.h, in the `probes` cells (at least 1) nearest to each query alone,
// ties to the smaller cell. Prototype i of `centroids` is the centroid of cell i.
void search_cells(const PackedPrototypes& prototypes, const CellView& cells,
                  const PackedPrototypes& centroids, std::size_t probes, Codes queries,
                  const SearchOptions& options, MatrixView<std::int64_t> ids,
                  MatrixView<float> distances);
void search_cells(const PackedPrototypes4& prototypes, const CellView& cells,
                  const PackedPrototypes& centroids, std::size_t probes, Codes queries,
                  const SearchOptions& options, MatrixView<std::int64_t> ids,
                  MatrixView<float> distances);

}  // namespace protomark
