#include "map/row_table.h"

#include <cmath>
#include <utility>

namespace protomark {

bool has_position(const Position& p) {
  return !(std::isnan(p[0]) && std::isnan(p[1]) && std::isnan(p[2]));
}

LandmarkIndex RowTable::at(std::int64_t id) const {
  const LandmarkIndex landmark = find(id);
  if (landmark == kNoLandmark) throw UnknownLandmark(id);
  return landmark;
}

std::size_t RowTable::row_count(LandmarkIndex landmark) const {
  std::size_t n = 0;
  for (Row row = first_row(landmark); row != kNoRow; row = next_row(row)) ++n;
  return n;
}

std::vector<Row> RowTable::sorted_rows(LandmarkIndex landmark) const {
  return sorted_rows(std::span(&landmark, 1));
}

std::vector<Row> RowTable::sorted_rows(std::span<const LandmarkIndex> landmarks) const {
  std::vector<Row> result;
  result.reserve(landmarks.size());
  for (const LandmarkIndex landmark : landmarks) {
    const auto first = static_cast<std::ptrdiff_t>(result.size());
    for (Row row = first_row(landmark); row != kNoRow; row = next_row(row)) result.push_back(row);
    if (several_) {
      std::sort(result.begin() + first, result.end(),
                [&](Row a, Row b) { return appearance(a) < appearance(b); });
    }
  }
  return result;
}

bool RowTable::any_position() const { return std::ranges::any_of(positions_, has_position); }

std::size_t RowTable::row_bytes() const {
  if (several_) return sizeof(appearances_[0]) + sizeof(owners_[0]) + sizeof(next_rows_[0]);
  return sizeof(ids_[0]) + (any_position() ? sizeof(Position) : 0);
}

void RowTable::make_room_for_landmark() {
  index_.make_room(ids_, 1);
  if (!several_) return;
  for_each_array(1, 0, [](auto& v, std::size_t more, const auto&) { make_room_in(v, more); });
}

void RowTable::add_landmark(std::int64_t id, Row row, std::uint16_t appearance) {
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

void RowTable::add_row(LandmarkIndex landmark, Row row, std::uint16_t appearance) {
  appearances_[row.value] = appearance;
  owners_[row.value] = landmark;
  next_rows_[row.value] = std::exchange(first_rows_[landmark.value], row);
}

// What leads to a row: the landmark's first row, or the next row of another one.
Row& RowTable::link_to(Row row) {
  Row* link = &first_rows_[owner(row).value];
  for (; *link != row; ++steps_) link = &next_rows_[link->value];
  return *link;
}

void RowTable::remove_row(Row row) {
  if (!several_) return index_.erase(ids_, ids_[row.value]);
  const LandmarkIndex landmark = owner(row);
  link_to(row) = next_row(row);
  if (first_row(landmark) == kNoRow) remove_landmark(landmark);
}

// The last landmark takes the index of one that has no rows left.
void RowTable::remove_landmark(LandmarkIndex landmark) {
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

void RowTable::relink(Row from, Row to) {
  if (several_) {
    link_to(from) = to;
  } else {
    index_.move(ids_, ids_[from.value], LandmarkIndex{to.value});
  }
}

void RowTable::relink(std::span<const Row> to) {
  if (!several_) return index_.renumber(to);
  for (auto* links : {&first_rows_, &next_rows_}) {
    for (Row& row : *links) {
      if (row != kNoRow) row = to[row.value];
    }
  }
}

void RowTable::set_position(LandmarkIndex landmark, const Position& position) {
  if (positions_.empty()) {
    if (!has_position(position)) return;
    positions_.assign(ids_.size(), kNoPosition);
  }
  // One NaN for all, so that equal maps give equal files.
  positions_[landmark.value] = has_position(position) ? position : kNoPosition;
}

}  // namespace protomark
