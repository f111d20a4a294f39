#include "map/prototype_store.h"

#include <algorithm>
#include <cstring>
#include <mutex>
#include <numeric>
#include <stdexcept>

#include "base/sorted_pieces.h"

namespace protomark {
namespace {

constexpr Row row_at(std::size_t i) { return Row{static_cast<std::uint32_t>(i)}; }

}  // namespace

std::size_t PrototypeStore::row_bytes() const {
  return dim_ * sizeof(sums_[0]) + packed_dim(dim_) + sizeof(counts_[0]) + RowTable::row_bytes();
}

void PrototypeStore::reserve(std::size_t landmarks, std::size_t rows) {
  // And the block that take_row wants to be free.
  const std::size_t blocks = (rows + kPackedRows - 1) / kPackedRows + 1;
  for_each_array(landmarks, blocks * kPackedRows,
                 [](auto& v, std::size_t n, const auto&) { v.reserve(n); });
  lists_.reserve(blocks);
}

void PrototypeStore::make_room(std::size_t landmarks, std::size_t rows, std::size_t changed,
                               FairSharedMutex& searching) {
  // New rows begin in the first list, and each that moves on may be the first of a block.
  const std::size_t moving = quantizer_.nlist() == 0 ? 0 : std::min(changed, quantizer_.nlist());
  const std::size_t blocks = 2 * ((rows + kPackedRows - 1) / kPackedRows) + moving;
  for_each_array(landmarks, blocks * kPackedRows, [&](auto& v, std::size_t more, const auto&) {
    if (!has_room(v, more)) enlarge(v, larger_capacity(v, more), searching);
  });
  if (!index_.has_room(landmarks)) {
    IdIndex larger = index_.with_room(ids_, landmarks);
    const std::unique_lock lock(searching);
    std::swap(index_, larger);
  }
}

void PrototypeStore::make_room_for_positions(FairSharedMutex& searching) {
  if (!positions_.empty()) return;
  std::vector<Position> fresh(ids_.size(), kNoPosition);
  const std::unique_lock lock(searching);
  positions_.swap(fresh);
}

Row PrototypeStore::find_or_create_row(std::int64_t id, std::uint16_t appearance) {
  const LandmarkIndex landmark = find(id);
  if (landmark == kNoLandmark) return create_landmark(id, appearance);
  const Row row = find_row(landmark, appearance);
  return row != kNoRow ? row : create_row(landmark, appearance);
}

Row PrototypeStore::create_landmark(std::int64_t id, std::uint16_t appearance) {
  const Row row = take_row(0);
  try {
    add_landmark(id, row, appearance);
  } catch (...) {
    close_gap(row);
    throw;
  }
  return row;
}

Row PrototypeStore::create_row(LandmarkIndex landmark, std::uint16_t appearance) {
  const Row row = take_row(0);
  add_row(landmark, row, appearance);
  return row;
}

// Makes room for a row at the end of a list.
Row PrototypeStore::take_row(std::uint32_t list) {
  if (row_end() + kPackedRows > UINT32_MAX) {
    throw std::length_error("a map holds under 2^32 prototypes");
  }
  lists_.make_room();
  for_each_array(0, kPackedRows,
                 [](auto& v, std::size_t more, const auto&) { make_room_in(v, more); });
  const Row row = lists_.append(list);
  if (row_end() != counts_.size()) resize(row_end());
  ++prototype_count_;
  std::fill_n(sum(row), dim_, std::int16_t{0});
  counts_[row.value] = 0;
  // No prototype has this number, so that the first one differs.
  packed()[packed_index(row.value, 0, dim_)] = -128;
  return row;
}

void PrototypeStore::resize(std::size_t rows) {
  for_each_array(ids_.size(), rows,
                 [](auto& v, std::size_t n, const auto& padding) { v.resize(n, padding); });
}

void PrototypeStore::copy_row(Row from, Row to) {
  for_each_plain_array(0, 1, [&](auto& v, std::size_t width, const auto&) {
    std::copy_n(v.data() + from.value * width, width, v.data() + to.value * width);
  });
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::memcpy(packed() + packed_index(to.value, d, dim_),
                packed() + packed_index(from.value, d, dim_), 4);
  }
}

void PrototypeStore::vacate(Row row) {
  for_each_plain_array(0, 1, [&](auto& v, std::size_t width, const auto& padding) {
    std::fill_n(v.data() + row.value * width, width, padding);
  });
}

void PrototypeStore::relocate(Row from, Row to) {
  relink(from, to);
  copy_row(from, to);
  vacate(from);
}

// The last row of its list takes the place of a row that is gone. If that empties a block, the last
// block of all takes its place.
void PrototypeStore::close_gap(Row row) {
  vacate(row);
  const std::uint32_t list = lists_.list_of(row);
  if (const Row last = lists_.last(list); last != row) relocate(last, row);
  const std::uint32_t emptied = lists_.pop(list);
  --prototype_count_;
  ++changes_;
  if (emptied == ListBlocks::kNone) return;
  const std::size_t moved = lists_.blocks();
  for (std::size_t i = 0; emptied != moved && i < kPackedRows; ++i) {
    const Row from = row_at(moved * kPackedRows + i);
    if (is_row(from)) relocate(from, row_at(emptied * kPackedRows + i));
  }
  resize(row_end());
}

void PrototypeStore::erase_row(Row row) {
  if (uncommitted) uncommitted->insert(id(owner(row)));
  remove_row(row);
  close_gap(row);
}

void PrototypeStore::erase(std::int64_t id) {
  const LandmarkIndex landmark = at(id);
  while (next_row(first_row(landmark)) != kNoRow) erase_row(first_row(landmark));
  erase_row(first_row(landmark));
}

std::uint32_t PrototypeStore::observations(LandmarkIndex landmark) const {
  std::uint32_t n = 0;
  for (const Row row : rows(landmark)) n += counts_[row.value];
  return n;
}

void PrototypeStore::rounded(Row row, std::int8_t* to) const {
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::copy_n(packed() + packed_index(row.value, d, dim_), std::min<std::size_t>(4, dim_ - d),
                to + d);
  }
}

std::vector<std::int8_t> PrototypeStore::rounded(std::span<const Row> rows) const {
  std::vector<std::int8_t> result(rows.size() * dim_);
  for (std::size_t i = 0; i < rows.size(); ++i) rounded(rows[i], &result[i * dim_]);
  return result;
}

void PrototypeStore::visit_sorted_landmarks(const VisitLandmarks& visit) const {
  std::int64_t largest = -1;
  bool ascending = true;
  for (const std::int64_t id : ids_) {
    ascending = ascending && (id < 0 || id > largest);
    largest = std::max(largest, id);
  }
  // To look up all ids that there may be is quicker than to sort those that are there.
  if (!ascending && static_cast<std::size_t>(largest) < 2 * landmark_count()) {
    constexpr std::size_t kPiece = 1 << 13;
    std::vector<LandmarkIndex> piece;
    for (std::int64_t id = 0; id <= largest; ++id) {
      if (const auto landmark = find(id); landmark != kNoLandmark) piece.push_back(landmark);
      if (piece.size() < kPiece && id < largest) continue;
      visit(piece);
      piece.clear();
    }
    return;
  }
  const auto each = [&](const auto& take) {
    for (std::uint32_t i = 0; i < ids_.size(); ++i) {
      if (ids_[i] >= 0) take(LandmarkIndex{i});
    }
  };
  visit_sorted<LandmarkIndex>(
      landmark_count(), each, [&](LandmarkIndex landmark) { return id(landmark); }, visit);
}

void PrototypeStore::visit_sorted_rows(std::uint32_t list, const VisitRows& visit) const {
  const auto each = [&](const auto& take) { lists_.each_row(list, take); };
  visit_sorted<Row>(
      lists_.rows(list), each, [&](Row row) { return std::pair(id(owner(row)), appearance(row)); },
      visit);
}

std::vector<LandmarkIndex> PrototypeStore::sorted_landmarks() const {
  std::vector<LandmarkIndex> result;
  result.reserve(landmark_count());
  visit_sorted_landmarks(
      [&](auto piece) { result.insert(result.end(), piece.begin(), piece.end()); });
  return result;
}

std::vector<Row> PrototypeStore::sorted_rows_at(std::span<const std::size_t> n) const {
  std::vector<std::size_t> ascending(n.size());
  std::iota(ascending.begin(), ascending.end(), std::size_t{0});
  std::ranges::sort(ascending, {}, [&](std::size_t i) { return n[i]; });
  std::vector<Row> result(n.size());
  std::size_t seen = 0;
  auto next = ascending.begin();
  visit_sorted_landmarks([&](std::span<const LandmarkIndex> landmarks) {
    const std::vector<Row> rows = sorted_rows(landmarks);
    for (; next != ascending.end() && n[*next] < seen + rows.size(); ++next) {
      result[*next] = rows[n[*next] - seen];
    }
    seen += rows.size();
  });
  return result;
}

void PrototypeStore::set_position(LandmarkIndex landmark, const Position& position) {
  RowTable::set_position(landmark, position);
  if (uncommitted) uncommitted->insert(id(landmark));
}

PackedPrototypes PrototypeStore::view() const {
  PackedPrototypes result{packed(), row_end(), dim_};
  result.landmarks.ids = ids_.data();
  if (several_) result.landmarks.of_row = owners_.data();
  return result;
}

}  // namespace protomark
