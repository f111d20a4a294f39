// The inverted lists of a learning map.
#pragma once

#include "search/packed.h"

namespace protomark {

// A list is a chain of blocks of kPackedRows rows, all full but the last one, which is not empty.
class ListBlocks {
 public:
  static constexpr uint32_t kNone = UINT32_MAX;

  explicit ListBlocks(size_t nlist = 1) : lists_(nlist) {}

  size_t nlist() const { return lists_.size(); }
  size_t blocks() const { return blocks_.size(); }
  size_t rows(uint32_t list) const { return lists_[list].rows; }
  uint32_t list_of(Row row) const { return blocks_[row.value / kPackedRows].list; }
  // Returns the last row of a list that is not empty.
  Row last(uint32_t list) const {
    const List& l = lists_[list];
    return {static_cast<uint32_t>(l.last * kPackedRows + (l.rows - 1) % kPackedRows)};
  }
  void each_row(uint32_t list, const auto& take) const {
    if (lists_[list].rows == 0) return;
    size_t in_block = (lists_[list].rows - 1) % kPackedRows + 1;
    for (uint32_t b = lists_[list].last; b != kNone; b = blocks_[b].previous) {
      for (size_t i = 0; i < in_block; ++i) {
        take(Row{static_cast<uint32_t>(b * kPackedRows + i)});
      }
      in_block = kPackedRows;
    }
  }
  // Appends the blocks of a list to `to`, the last one first.
  void append_blocks(uint32_t list, std::vector<uint32_t>& to) const {
    for (uint32_t b = lists_[list].last; b != kNone; b = blocks_[b].previous) to.push_back(b);
  }

  void reserve(size_t blocks) { blocks_.reserve(blocks); }
  // Makes sure that the next append cannot run out of memory.
  void make_room() {
    if (blocks_.size() == blocks_.capacity()) reserve(std::max<size_t>(16, 2 * blocks()));
  }
  Row append(uint32_t list) {
    List& l = lists_[list];
    if (l.rows++ % kPackedRows == 0) {
      const auto block = static_cast<uint32_t>(blocks());
      make_room();
      blocks_.push_back({list, l.last, kNone});
      if (l.last != kNone) blocks_[l.last].next = block;
      l.last = block;
    }
    return last(list);
  }
  // Removes the last row of a list. If that empties its block, returns that block, to which the
  // caller must move the rows of the last of all blocks; else kNone.
  uint32_t pop(uint32_t list) {
    List& l = lists_[list];
    if (--l.rows % kPackedRows != 0) return kNone;
    const uint32_t emptied = l.last;
    l.last = blocks_[emptied].previous;
    if (l.last != kNone) blocks_[l.last].next = kNone;
    if (emptied + 1 != blocks()) {
      const Block& moved = blocks_[emptied] = blocks_.back();
      if (moved.previous != kNone) blocks_[moved.previous].next = emptied;
      (moved.next != kNone ? blocks_[moved.next].previous : lists_[moved.list].last) = emptied;
    }
    blocks_.pop_back();
    return emptied;
  }

 private:
  struct List {
    uint32_t last = kNone;  // block
    uint32_t rows = 0;
  };
  struct Block {
    uint32_t list, previous, next;  // and the blocks before and after it in that
  };
  std::vector<List> lists_;
  std::vector<Block> blocks_;
};

}  // namespace protomark
