// The inverted lists of a learning map.
#pragma once

#include <algorithm>

#include "search/packed.h"

namespace protomark {

// A list is a chain of blocks of kPackedRows rows, all full but the last one, which is not empty.
class ListBlocks {
 public:
  static constexpr std::uint32_t kNone = UINT32_MAX;

  explicit ListBlocks(std::size_t nlist = 1) : lists_(nlist) {}

  std::size_t nlist() const { return lists_.size(); }
  std::size_t blocks() const { return list_.size(); }
  std::size_t rows(std::uint32_t list) const { return lists_[list].rows; }
  std::uint32_t list_of(Row row) const { return list_[row.value / kPackedRows]; }
  // Returns the last row of a list that is not empty.
  Row last(std::uint32_t list) const {
    const List& l = lists_[list];
    return {static_cast<std::uint32_t>(l.last * kPackedRows + (l.rows - 1) % kPackedRows)};
  }
  // Calls take(row) for each row of a list.
  template <typename Take>
  void each_row(std::uint32_t list, const Take& take) const {
    if (lists_[list].rows == 0) return;
    std::size_t in_block = (lists_[list].rows - 1) % kPackedRows + 1;
    for (std::uint32_t b = lists_[list].last; b != kNone; b = previous_[b]) {
      for (std::size_t i = 0; i < in_block; ++i) {
        take(Row{static_cast<std::uint32_t>(b * kPackedRows + i)});
      }
      in_block = kPackedRows;
    }
  }
  // Appends the blocks of a list to `to`, the last one first.
  void append_blocks(std::uint32_t list, std::vector<std::uint32_t>& to) const {
    for (std::uint32_t b = lists_[list].last; b != kNone; b = previous_[b]) to.push_back(b);
  }

  void reserve(std::size_t blocks) {
    for (auto* v : {&list_, &previous_, &next_}) v->reserve(blocks);
  }
  // Makes sure that the next append cannot run out of memory.
  void make_room() {
    if (list_.size() < std::min({list_.capacity(), previous_.capacity(), next_.capacity()})) return;
    reserve(std::max<std::size_t>(16, 2 * list_.size()));
  }
  // Adds a row to a list, and returns it.
  Row append(std::uint32_t list) {
    List& l = lists_[list];
    if (l.rows++ % kPackedRows == 0) {
      const auto block = static_cast<std::uint32_t>(blocks());
      make_room();
      list_.push_back(list);
      previous_.push_back(l.last);
      next_.push_back(kNone);
      if (l.last != kNone) next_[l.last] = block;
      l.last = block;
    }
    return last(list);
  }
  // Removes the last row of a list. If that empties its block, returns that block, to which the
  // caller must move the rows of the last of all blocks; else kNone.
  std::uint32_t pop(std::uint32_t list) {
    List& l = lists_[list];
    if (--l.rows % kPackedRows != 0) return kNone;
    const std::uint32_t emptied = l.last;
    l.last = previous_[emptied];
    if (l.last != kNone) next_[l.last] = kNone;
    const auto moved = static_cast<std::uint32_t>(blocks() - 1);
    if (emptied != moved) {
      list_[emptied] = list_[moved];
      previous_[emptied] = previous_[moved];
      next_[emptied] = next_[moved];
      if (previous_[emptied] != kNone) next_[previous_[emptied]] = emptied;
      (next_[emptied] != kNone ? previous_[next_[emptied]] : lists_[list_[emptied]].last) = emptied;
    }
    for (auto* v : {&list_, &previous_, &next_}) v->pop_back();
    return emptied;
  }

 private:
  struct List {
    std::uint32_t last = kNone;  // block
    std::uint32_t rows = 0;
  };
  std::vector<List> lists_;
  // Of each block: its list, and the blocks before and after it in that.
  std::vector<std::uint32_t> list_, previous_, next_;
};

}  // namespace protomark
