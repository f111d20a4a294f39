// The rows of each landmark of a learning map, and the landmark of each row.
#pragma once

#include <algorithm>
#include <limits>
#include <mutex>

#include "base/fair_shared_mutex.h"
#include "base/id_index.h"
#include "base/large_vector.h"
#include "base/rows.h"
#include "protomark/types.h"

namespace protomark {

inline constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
inline constexpr Position kNoPosition = {kNaN, kNaN, kNaN};
bool has_position(const Position& position);

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
  const LargeVector<std::int64_t>& ids() const { return ids_; }
  std::int64_t id(LandmarkIndex landmark) const { return ids_[landmark.value]; }
  // Return the landmark with an id; if there is none, kNoLandmark, or `at` throws UnknownLandmark.
  LandmarkIndex find(std::int64_t id) const { return index_.find(ids_, id); }
  LandmarkIndex at(std::int64_t id) const;

  LandmarkIndex owner(Row row) const {
    return several_ ? owners_[row.value] : LandmarkIndex{row.value};
  }
  bool is_row(Row row) const {
    return several_ ? owners_[row.value] != kNoLandmark : ids_[row.value] >= 0;
  }
  std::uint16_t appearance(Row row) const { return several_ ? appearances_[row.value] : 0; }
  // Run through the rows of a landmark, in no order, up to kNoRow.
  Row first_row(LandmarkIndex landmark) const {
    return several_ ? first_rows_[landmark.value] : Row{landmark.value};
  }
  Row next_row(Row row) const { return several_ ? next_rows_[row.value] : kNoRow; }
  // Returns the row of a landmark's appearance, or kNoRow.
  Row find_row(LandmarkIndex landmark, std::uint16_t appearance) const {
    Row row = first_row(landmark);
    while (several_ && row != kNoRow && appearances_[row.value] != appearance) row = next_row(row);
    return row;
  }

  std::size_t row_count(LandmarkIndex landmark) const;
  // Return the rows of a landmark by ascending appearance, or of several landmarks in their order.
  std::vector<Row> sorted_rows(LandmarkIndex landmark) const;
  std::vector<Row> sorted_rows(std::span<const LandmarkIndex> landmarks) const;

  Position position(LandmarkIndex landmark) const {
    return positions_.empty() ? kNoPosition : positions_[landmark.value];
  }
  // By landmark index; empty if no landmark ever had a position.
  const std::vector<Position>& positions() const { return positions_; }
  bool any_position() const;

  // Counts rows that were stepped over to remove or move others.
  std::size_t steps() const { return steps_; }

 protected:
  // Makes room for a landmark, without which add_landmark could run out of memory.
  void make_room_for_landmark();
  // Makes a padding row the only one of a new landmark.
  void add_landmark(std::int64_t id, Row row, std::uint16_t appearance);
  // Makes a padding row one more of a landmark.
  void add_row(LandmarkIndex landmark, Row row, std::uint16_t appearance);
  // Removes a row from its landmark, and a landmark with its last row.
  void remove_row(Row row);
  // Make what leads to one row lead to another, or all that leads to rows lead to to[row].
  void relink(Row from, Row to);
  void relink(std::span<const Row> to);
  void set_position(LandmarkIndex landmark, const Position& position);

  // Bytes per row as in a file, so that equal maps have the same.
  std::size_t row_bytes() const;
  // Calls visit(array, size, padding) for each array, with its size for these numbers of landmarks
  // and rows.
  template <typename Visit>
  void for_each_array(std::size_t landmarks, std::size_t rows, const Visit& visit) {
    if (!several_) landmarks = rows;
    visit(ids_, landmarks, std::int64_t{-1});
    if (!positions_.empty()) visit(positions_, landmarks, kNoPosition);
    if (!several_) return;
    visit(first_rows_, landmarks, kNoRow);
    visit(appearances_, rows, std::uint16_t{0});
    visit(owners_, rows, kNoLandmark);
    visit(next_rows_, rows, kNoRow);
  }

  bool several_;
  // By landmark; first rows only with several per landmark.
  LargeVector<std::int64_t> ids_;
  std::vector<Position> positions_;
  std::vector<Row> first_rows_;
  // By row, only with several per landmark.
  std::vector<std::uint16_t> appearances_;
  std::vector<LandmarkIndex> owners_;
  std::vector<Row> next_rows_;

  IdIndex index_;

 private:
  Row& link_to(Row row);
  void remove_landmark(LandmarkIndex landmark);

  std::size_t steps_ = 0;
};

// Arrays grow as with push_back, but before a change, which therefore cannot fail half-way.
template <typename Vector>
std::size_t larger_capacity(const Vector& v, std::size_t more) {
  return std::max(2 * v.capacity(), v.size() + more);
}
template <typename Vector>
bool has_room(const Vector& v, std::size_t more) {
  return v.capacity() - v.size() >= more;
}
template <typename Vector>
void make_room_in(Vector& v, std::size_t more) {
  if (!has_room(v, more)) v.reserve(larger_capacity(v, more));
}
// Replaces an array by one of more capacity; only the swap excludes searches.
template <typename Vector>
void enlarge(Vector& v, std::size_t capacity, FairSharedMutex& searching) {
  Vector larger;
  larger.reserve(capacity);
  larger.assign(v.begin(), v.end());
  const std::unique_lock lock(searching);
  v.swap(larger);
}

}  // namespace protomark
