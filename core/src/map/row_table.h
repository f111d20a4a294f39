// The rows of each landmark of a learning map, and the landmark of each row.
#pragma once

#include <cmath>
#include <limits>
#include <mutex>
#include <utility>

#include "base/fair_shared_mutex.h"
#include "base/id_index.h"
#include "protomark/types.h"

namespace protomark {

inline constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
inline constexpr Position kNoPosition = {kNaN, kNaN, kNaN};
inline bool has_position(const Position& p) {
  return !(std::isnan(p[0]) && std::isnan(p[1]) && std::isnan(p[2]));
}
inline bool is_finite(const Position& p) {
  return std::ranges::all_of(p, [](double x) { return std::isfinite(x); });
}

// Returns the capacity for more elements, as push_back would. Arrays grow before a change.
size_t capacity_for(const auto& v, size_t more) {
  const size_t size = v.size() + more;
  return size <= v.capacity() ? v.capacity() : std::max(2 * v.capacity(), size);
}
// Replaces an array by one of more capacity; only the swap excludes searches.
template <typename Vector>
void enlarge(Vector& v, size_t capacity, FairSharedMutex& searching) {
  if (v.capacity() >= capacity) return;
  Vector larger;
  larger.reserve(capacity);
  larger.assign(v.begin(), v.end());
  const std::unique_lock lock(searching);
  v.swap(larger);
}

// Has two layouts. With one row per landmark, a landmark has the index of its row, and only ids and
// positions are stored, by row. With one row per appearance, landmarks have indices of their own,
// without gaps, and the rows of a landmark form a chain.
//
// Neither landmarks nor rows are sorted. Rows of no landmark are padding. Indices change when a
// landmark or row is removed, as others then get its index.
class RowTable {
 public:
  // `several`: a landmark may have several rows.
  explicit RowTable(bool several) : several_(several) {}

  // By landmark index; -1 for padding.
  const LargeVector<int64_t>& ids() const { return ids_; }
  int64_t id(LandmarkIndex landmark) const { return ids_[landmark.value]; }
  LandmarkIndex find(int64_t id) const { return index_.find(ids_, id); }
  // Throws UnknownLandmark.
  LandmarkIndex at(int64_t id) const {
    const LandmarkIndex landmark = find(id);
    if (landmark == kNoLandmark) throw UnknownLandmark(id);
    return landmark;
  }
  LandmarkIndex owner(Row row) const {
    return several_ ? owners_[row.value] : LandmarkIndex{row.value};
  }
  bool is_row(Row row) const {
    return several_ ? owners_[row.value] != kNoLandmark : ids_[row.value] >= 0;
  }
  uint16_t appearance(Row row) const { return several_ ? appearances_[row.value] : 0; }
  // Run through the rows of a landmark, in no order, up to kNoRow.
  Row first_row(LandmarkIndex landmark) const {
    return several_ ? first_rows_[landmark.value] : Row{landmark.value};
  }
  Row next_row(Row row) const { return several_ ? next_rows_[row.value] : kNoRow; }
  void each_row_of(LandmarkIndex landmark, const auto& take) const {
    for (Row row = first_row(landmark); row != kNoRow; row = next_row(row)) take(row);
  }
  // Steps from a row to that of an appearance, or to kNoRow, but over at most `limit` others.
  Row walk(Row row, uint16_t appearance, size_t limit) const {
    if (!several_) return row;
    size_t steps = 0;
    for (; row != kNoRow && appearances_[row.value] != appearance && steps < limit; ++steps) {
      row = next_row(row);
    }
    steps_ += steps;
    return row;
  }
  // Only changes may call this.
  Row find_row(LandmarkIndex landmark, uint16_t appearance) const {
    return walk(first_row(landmark), appearance, SIZE_MAX);
  }
  Row find_row(int64_t id, uint16_t appearance) const {
    const LandmarkIndex landmark = find(id);
    return landmark == kNoLandmark ? kNoRow : find_row(landmark, appearance);
  }

  size_t row_count(LandmarkIndex landmark) const {
    size_t n = 0;
    each_row_of(landmark, [&](Row) { ++n; });
    return n;
  }
  std::vector<Row> sorted_rows(LandmarkIndex landmark) const {
    return sorted_rows(std::span(&landmark, 1));
  }
  // Returns the rows of one landmark after the other, by ascending appearance.
  std::vector<Row> sorted_rows(std::span<const LandmarkIndex> landmarks) const {
    std::vector<Row> result;
    result.reserve(landmarks.size());
    for (const LandmarkIndex landmark : landmarks) {
      const auto first = static_cast<std::ptrdiff_t>(result.size());
      each_row_of(landmark, [&](Row row) { result.push_back(row); });
      std::ranges::sort(result.begin() + first, result.end(), {},
                        [&](Row row) { return appearance(row); });
    }
    return result;
  }

  Position position(LandmarkIndex landmark) const {
    return positions_.empty() ? kNoPosition : positions_[landmark.value];
  }
  // By landmark index; empty if no landmark ever had a position.
  const std::vector<Position>& positions() const { return positions_; }

  // Counts rows that changes stepped over to find, remove or move others.
  size_t steps() const { return steps_; }

 protected:
  // Without this, add_landmark could run out of memory.
  void make_room_for_landmark() {
    index_.make_room(ids_, 1);
    if (!several_) return;
    for_each_array(1, 0, [](auto& v, size_t n, const auto&) { v.reserve(capacity_for(v, n)); });
  }
  // Makes a padding row the only one of a new landmark.
  void add_landmark(int64_t id, Row row, uint16_t appearance) {
    if (!several_) {
      ids_[row.value] = id;
      index_.insert(ids_, LandmarkIndex{row.value});
      return;
    }
    const LandmarkIndex landmark = landmark_at(ids_.size());
    ids_.push_back(id);
    index_.insert(ids_, landmark);
    first_rows_.push_back(kNoRow);
    if (!positions_.empty()) positions_.push_back(kNoPosition);
    add_row(landmark, row, appearance);
  }
  void add_row(LandmarkIndex landmark, Row row, uint16_t appearance) {
    appearances_[row.value] = appearance;
    owners_[row.value] = landmark;
    next_rows_[row.value] = std::exchange(first_rows_[landmark.value], row);
  }
  void remove_row(Row row) {
    if (!several_) return index_.erase(ids_, ids_[row.value]);
    const LandmarkIndex landmark = owner(row);
    link_to(row) = next_row(row);
    if (first_row(landmark) == kNoRow) remove_landmark(landmark);
  }
  // Make what leads to one row lead to another, or all that leads to rows lead to to[row].
  void relink(Row from, Row to) {
    if (several_) {
      link_to(from) = to;
    } else {
      index_.move(ids_, ids_[from.value], LandmarkIndex{to.value});
    }
  }
  void relink(std::span<const Row> to) {
    if (!several_) return index_.renumber(to);
    for (auto* links : {&first_rows_, &next_rows_}) {
      for (Row& row : *links) {
        if (row != kNoRow) row = to[row.value];
      }
    }
  }
  // Takes a copy, as a caller may write over a position that was checked.
  void set_position(LandmarkIndex landmark, Position position) {
    if (positions_.empty()) {
      if (!has_position(position)) return;
      positions_.assign(ids_.size(), kNoPosition);
    }
    // One NaN for all, so that equal maps give equal files.
    positions_[landmark.value] = is_finite(position) ? position : kNoPosition;
  }

  // Bytes per row as in a file, so that equal maps have the same.
  size_t row_bytes() const {
    if (several_) return sizeof(appearances_[0]) + sizeof(owners_[0]) + sizeof(next_rows_[0]);
    const bool placed = std::ranges::any_of(positions_, has_position);
    return sizeof(ids_[0]) + (placed ? sizeof(Position) : 0);
  }
  // Calls visit(array, size for so many landmarks and rows, padding) for each array.
  void for_each_array(size_t landmarks, size_t rows, const auto& visit) {
    if (!several_) landmarks = rows;
    visit(ids_, landmarks, int64_t{-1});
    if (!positions_.empty()) visit(positions_, landmarks, kNoPosition);
    if (!several_) return;
    visit(first_rows_, landmarks, kNoRow);
    visit(appearances_, rows, uint16_t{0});
    visit(owners_, rows, kNoLandmark);
    visit(next_rows_, rows, kNoRow);
  }

  bool several_;
  // By landmark; first rows only with several per landmark.
  LargeVector<int64_t> ids_;
  std::vector<Position> positions_;
  std::vector<Row> first_rows_;
  // By row, only with several per landmark.
  std::vector<uint16_t> appearances_;
  std::vector<LandmarkIndex> owners_;
  std::vector<Row> next_rows_;

  IdIndex index_;

 private:
  // What leads to a row: the landmark's first row, or the next row of another one.
  Row& link_to(Row row) {
    Row* link = &first_rows_[owner(row).value];
    for (; *link != row; ++steps_) link = &next_rows_[link->value];
    return *link;
  }
  // The last landmark takes the index of one that has no rows left.
  void remove_landmark(LandmarkIndex landmark) {
    const LandmarkIndex last = landmark_at(ids_.size() - 1);
    index_.erase(ids_, id(landmark));
    if (landmark != last) {
      index_.move(ids_, id(last), landmark);
      ids_[landmark.value] = id(last);
      if (!positions_.empty()) positions_[landmark.value] = positions_[last.value];
      first_rows_[landmark.value] = first_row(last);
      for (Row row = first_row(landmark); row != kNoRow; row = next_row(row), ++steps_) {
        owners_[row.value] = landmark;
      }
    }
    ids_.pop_back();
    if (!positions_.empty()) positions_.pop_back();
    first_rows_.pop_back();
  }

  mutable size_t steps_ = 0;
};

}  // namespace protomark
