// Which rows of a map are in which cell.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "protomark/search.h"

namespace protomark {

// A cell is a chain of blocks of kPackedRows rows, all full but the last one, so that kernels scan
// it and 12 bytes a block are all it costs. There are no blocks without a row.
class CellBlocks {
 public:
  static constexpr std::uint32_t kNone = UINT32_MAX;

  explicit CellBlocks(std::size_t cells = 1) : cells_(cells) {}

  std::size_t cells() const { return cells_.size(); }
  std::size_t blocks() const { return cell_.size(); }
  // Rows of a cell.
  std::size_t rows(std::uint32_t cell) const { return cells_[cell].rows; }
  std::uint32_t cell_of(std::size_t row) const { return cell_[row / kPackedRows]; }
  // The row that came last into a cell that has one.
  std::uint32_t last(std::uint32_t cell) const {
    const Cell& c = cells_[cell];
    return static_cast<std::uint32_t>(c.last * kPackedRows + (c.rows - 1) % kPackedRows);
  }
  // Calls take(row) for each row of a cell.
  template <typename Take>
  void each_row(std::uint32_t cell, const Take& take) const {
    if (cells_[cell].rows == 0) return;
    std::size_t in_block = (cells_[cell].rows - 1) % kPackedRows + 1;
    for (std::uint32_t b = cells_[cell].last; b != kNone; b = previous_[b]) {
      for (std::size_t i = 0; i < in_block; ++i) {
        take(static_cast<std::uint32_t>(b * kPackedRows + i));
      }
      in_block = kPackedRows;
    }
  }
  // Appends the blocks of a cell, the last one first.
  void list(std::uint32_t cell, std::vector<std::uint32_t>& to) const {
    for (std::uint32_t b = cells_[cell].last; b != kNone; b = previous_[b]) to.push_back(b);
  }

  void reserve(std::size_t blocks) {
    for (auto* v : {&cell_, &previous_, &next_}) v->reserve(blocks);
  }
  // Afterwards the next append does not throw for want of memory.
  void make_room() {
    if (cell_.size() < std::min({cell_.capacity(), previous_.capacity(), next_.capacity()})) return;
    reserve(std::max<std::size_t>(16, 2 * cell_.size()));
  }
  // A row more, which may be the first one of a new last block.
  std::uint32_t append(std::uint32_t cell) {
    Cell& c = cells_[cell];
    if (c.rows++ % kPackedRows == 0) {
      const auto block = static_cast<std::uint32_t>(blocks());
      make_room();
      cell_.push_back(cell);
      previous_.push_back(c.last);
      next_.push_back(kNone);
      if (c.last != kNone) next_[c.last] = block;
      c.last = block;
    }
    return last(cell);
  }
  // Takes the last row away. Where that empties its block, the last of all blocks is to take its
  // place, which is returned; else kNone.
  std::uint32_t pop(std::uint32_t cell) {
    Cell& c = cells_[cell];
    if (--c.rows % kPackedRows != 0) return kNone;
    const std::uint32_t gone = c.last;
    c.last = previous_[gone];
    if (c.last != kNone) next_[c.last] = kNone;
    const auto moved = static_cast<std::uint32_t>(blocks() - 1);
    if (gone != moved) {
      cell_[gone] = cell_[moved];
      previous_[gone] = previous_[moved];
      next_[gone] = next_[moved];
      if (previous_[gone] != kNone) next_[previous_[gone]] = gone;
      (next_[gone] != kNone ? previous_[next_[gone]] : cells_[cell_[gone]].last) = gone;
    }
    for (auto* v : {&cell_, &previous_, &next_}) v->pop_back();
    return gone;
  }

 private:
  struct Cell {
    std::uint32_t last = kNone;  // block
    std::uint32_t rows = 0;
  };
  std::vector<Cell> cells_;
  // Of each block: its cell, and the blocks before and after it there.
  std::vector<std::uint32_t> cell_;
  std::vector<std::uint32_t> previous_;
  std::vector<std::uint32_t> next_;
};

}  // namespace protomark
