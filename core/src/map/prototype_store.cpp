#include "map/prototype_store.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numeric>
#include <stdexcept>
#include <utility>

#include "base/sorted_pieces.h"
#include "protomark/error.h"

namespace protomark {
namespace {

// Rows that are put into cells at a time.
constexpr std::size_t kSettleChunk = 1 << 16;

}  // namespace

bool is_nowhere(const Position& p) {
  return std::isnan(p[0]) && std::isnan(p[1]) && std::isnan(p[2]);
}

std::uint16_t PrototypeStore::look_of(const std::int8_t* code) const {
  unsigned look = 0;
  for (std::size_t j = 0; j < look_bits_; ++j) look |= (code[j] > 0 ? 1u : 0u) << j;
  return static_cast<std::uint16_t>(look);
}

// Calls todo(array, elements) with what so many landmarks and places take of each array.
template <typename Do>
void PrototypeStore::for_each_array(std::size_t landmarks, std::size_t places, const Do& todo) {
  if (look_bits_ == 0) landmarks = places;
  todo(ids_, landmarks);
  if (!positions_.empty()) todo(positions_, landmarks);
  todo(sums_, places * dim_);
  todo(counts_, places);
  todo(packed_, packed_size(places, dim_) / sizeof(CodeVector));
  if (look_bits_ == 0) return;
  todo(heads_, landmarks);
  todo(looks_, places);
  todo(owners_, places);
  todo(next_, places);
}

std::size_t PrototypeStore::place_bytes() const {
  const std::size_t row = dim_ * sizeof(sums_[0]) + packed_dim(dim_) + sizeof(counts_[0]);
  if (look_bits_ != 0) return row + sizeof(looks_[0]) + sizeof(owners_[0]) + sizeof(next_[0]);
  const bool placed = !std::all_of(positions_.begin(), positions_.end(), is_nowhere);
  return row + sizeof(ids_[0]) + (placed ? sizeof(Position) : 0);
}

void PrototypeStore::reserve(std::size_t landmarks, std::size_t rows) {
  // And the one that make_room_for_row wants to be free.
  const std::size_t blocks = (rows + kPackedRows - 1) / kPackedRows + 1;
  for_each_array(landmarks, blocks * kPackedRows, [](auto& v, std::size_t n) { v.reserve(n); });
  blocks_.reserve(blocks);
}

std::uint32_t PrototypeStore::at(std::int64_t id) const {
  const std::uint32_t landmark = find(id);
  if (landmark == kNone) throw UnknownLandmark(id);
  return landmark;
}

std::uint32_t PrototypeStore::find_row(std::uint32_t landmark, std::uint16_t look) const {
  std::uint32_t row = first_row(landmark);
  while (row != kNone && this->look(row) != look) row = next_row(row);
  return row;
}

namespace {

template <typename Vector>
bool has_room(const Vector& v, std::size_t more) {
  return v.capacity() - v.size() >= more;
}

// As push_back grows, so that adding elements cannot fail half-way.
template <typename Vector>
std::size_t larger_capacity(const Vector& v, std::size_t more) {
  return std::max(2 * v.capacity(), v.size() + more);
}

template <typename Vector>
void make_room_in(Vector& v, std::size_t more) {
  if (!has_room(v, more)) v.reserve(larger_capacity(v, more));
}

template <typename Vector>
void enlarge(Vector& v, std::size_t capacity, const PrototypeStore::Alone& alone) {
  Vector larger;
  larger.reserve(capacity);
  larger.assign(v.begin(), v.end());
  alone([&] { v.swap(larger); });
}

}  // namespace

std::uint32_t PrototypeStore::find_or_create_row(std::int64_t id, std::uint16_t look) {
  std::uint32_t landmark = find(id);
  if (landmark == kNone) {
    make_room_for_row();  // so that a landmark that is there has a row
    landmark = create_landmark(id);
  } else if (const std::uint32_t row = find_row(landmark, look); row != kNone) {
    return row;
  }
  return create_row(landmark, look);
}

std::uint32_t PrototypeStore::create_landmark(std::int64_t id) {
  // Checked here for the row that will follow, so that no landmark is left without one.
  if (places() + kPackedRows > kNone) throw std::length_error("a map holds under 2^32 prototypes");
  std::uint32_t landmark;
  if (look_bits_ == 0) {
    landmark = take_place(0);
    ids_[landmark] = id;
  } else {
    landmark = static_cast<std::uint32_t>(landmarks());
    make_room_in(ids_, 1);
    make_room_in(positions_, 1);
    make_room_in(heads_, 1);
    ids_.push_back(id);
    heads_.push_back(kNone);
    if (!positions_.empty()) positions_.push_back(kNowhere);
  }
  try {
    index_.insert(ids_, landmark);
  } catch (...) {
    if (look_bits_ == 0) {
      close_gap(landmark);
    } else {
      ids_.pop_back();
      heads_.pop_back();
      if (!positions_.empty()) positions_.pop_back();
    }
    throw;
  }
  return landmark;
}

void PrototypeStore::make_room_for_row() {
  blocks_.make_room();
  for_each_array(0, kPackedRows, [](auto& v, std::size_t more) { make_room_in(v, more); });
}

void PrototypeStore::make_room(std::size_t landmarks, std::size_t rows, std::size_t changed,
                               const Alone& alone) {
  // New rows begin in the first cell, and each that moves may be the first of a block.
  const std::size_t moving = cells_.nlist() == 0 ? 0 : std::min(changed, cells_.nlist());
  const std::size_t blocks = 2 * ((rows + kPackedRows - 1) / kPackedRows) + moving;
  for_each_array(landmarks, blocks * kPackedRows, [&](auto& v, std::size_t more) {
    if (!has_room(v, more)) enlarge(v, larger_capacity(v, more), alone);
  });
  if (!index_.has_room(landmarks)) {
    IdIndex larger = index_.with_room(ids_, landmarks);
    alone([&] { std::swap(index_, larger); });
  }
}

void PrototypeStore::make_places(std::size_t places, const Alone& alone) {
  for_each_array(0, places, [&](auto& v, std::size_t n) {
    if (v.capacity() < n) enlarge(v, n, alone);
  });
}

void PrototypeStore::resize_rows(std::size_t places) {
  sums_.resize(places * dim_, 0);
  counts_.resize(places, 0);
  packed_.resize(packed_size(places, dim_) / sizeof(CodeVector));
  if (look_bits_ == 0) {
    ids_.resize(places, -1);
    if (!positions_.empty()) positions_.resize(places, kNowhere);
    return;
  }
  looks_.resize(places, 0);
  owners_.resize(places, kNone);
  next_.resize(places, kNone);
}

// Room for a row at the end of a cell.
std::uint32_t PrototypeStore::take_place(std::uint32_t cell) {
  if (places() + kPackedRows > kNone) throw std::length_error("a map holds under 2^32 prototypes");
  make_room_for_row();
  const std::uint32_t row = blocks_.append(cell).value;
  if (places() != counts_.size()) resize_rows(places());
  ++rows_;
  std::fill_n(sum(row), dim_, std::int16_t{0});
  counts_[row] = 0;
  // No prototype has this number, so that the first one differs.
  packed()[packed_index(row, 0, dim_)] = -128;
  return row;
}

std::uint32_t PrototypeStore::create_row(std::uint32_t landmark, std::uint16_t look) {
  if (look_bits_ == 0) return landmark;
  if (places() + kPackedRows > kNone) throw std::length_error("a map holds under 2^32 prototypes");
  const std::uint32_t row = take_place(0);
  looks_[row] = look;
  owners_[row] = landmark;
  next_[row] = heads_[landmark];
  heads_[landmark] = row;
  return row;
}

// The head or link that leads to a row.
std::uint32_t* PrototypeStore::link_to(std::uint32_t row) {
  std::uint32_t* link = &heads_[owners_[row]];
  for (; *link != row; ++steps_) link = &next_[*link];
  return link;
}

void PrototypeStore::read(std::uint32_t place, Row& row) const {
  std::copy_n(sum(place), dim_, row.sum.data());
  row.count = counts_[place];
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::memcpy(&row.rounded[d], packed() + packed_index(place, d, dim_), 4);
  }
  if (look_bits_ == 0) {
    row.id = ids_[place];
    if (!positions_.empty()) row.position = positions_[place];
  } else {
    row.look = looks_[place];
    row.owner = owners_[place];
    row.next = next_[place];
  }
}

void PrototypeStore::write(std::uint32_t place, const Row& row) {
  std::copy_n(row.sum.data(), dim_, sum(place));
  counts_[place] = row.count;
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::memcpy(packed() + packed_index(place, d, dim_), &row.rounded[d], 4);
  }
  if (look_bits_ == 0) {
    ids_[place] = row.id;
    if (!positions_.empty()) positions_[place] = row.position;
  } else {
    looks_[place] = row.look;
    owners_[place] = row.owner;
    next_[place] = row.next;
  }
}

// No row has this place any more.
void PrototypeStore::vacate(std::uint32_t place) {
  if (look_bits_ == 0) {
    ids_[place] = -1;
    if (!positions_.empty()) positions_[place] = kNowhere;
  } else {
    owners_[place] = kNone;
    next_[place] = kNone;
  }
}

// A row moves to a place that is free and leaves its own free.
void PrototypeStore::relocate(std::uint32_t from, std::uint32_t to) {
  if (look_bits_ == 0) {
    index_.move(ids_, ids_[from], to);
  } else {
    *link_to(from) = to;
  }
  Row row;
  read(from, row);
  write(to, row);
  vacate(from);
}

// The last row of its cell takes the place of a row that is gone; where a block becomes empty, the
// last block takes its place.
void PrototypeStore::close_gap(std::uint32_t row) {
  vacate(row);
  const std::uint32_t cell = blocks_.list_of({row});
  if (const std::uint32_t last = blocks_.last(cell).value; last != row) relocate(last, row);
  const std::uint32_t gone = blocks_.pop(cell);
  --rows_;
  ++changes_;
  if (gone == ListBlocks::kNone) return;
  const auto moved = static_cast<std::uint32_t>(blocks_.blocks());
  for (std::uint32_t i = 0; gone != moved && i < kPackedRows; ++i) {
    const std::uint32_t from = moved * kPackedRows + i;
    if (is_row(from)) relocate(from, gone * kPackedRows + i);
  }
  resize_rows(places());
}

// The last landmark takes the place of another one, which has no rows. Only with looks.
void PrototypeStore::erase_landmark(std::uint32_t landmark) {
  const auto last = static_cast<std::uint32_t>(landmarks() - 1);
  index_.erase(ids_, ids_[landmark]);
  if (landmark != last) {
    index_.move(ids_, ids_[last], landmark);
    ids_[landmark] = ids_[last];
    if (!positions_.empty()) positions_[landmark] = positions_[last];
    heads_[landmark] = heads_[last];
    for (std::uint32_t row = heads_[landmark]; row != kNone; row = next_[row]) {
      owners_[row] = landmark;
      ++steps_;
    }
  }
  ids_.pop_back();
  if (!positions_.empty()) positions_.pop_back();
  heads_.pop_back();
}

void PrototypeStore::erase_row(std::uint32_t row) {
  if (uncommitted_) uncommitted_->insert(ids_[landmark_of(row)]);
  if (look_bits_ == 0) {
    index_.erase(ids_, ids_[row]);
    close_gap(row);
    return;
  }
  const std::uint32_t landmark = owners_[row];
  *link_to(row) = next_[row];
  close_gap(row);
  if (heads_[landmark] == kNone) erase_landmark(landmark);
}

void PrototypeStore::erase(std::int64_t id) {
  const std::uint32_t landmark = at(id);
  while (next_row(first_row(landmark)) != kNone) erase_row(first_row(landmark));
  erase_row(first_row(landmark));
}

std::size_t PrototypeStore::rows_of(std::uint32_t landmark) const {
  std::size_t n = 0;
  for (std::uint32_t row = first_row(landmark); row != kNone; row = next_row(row)) ++n;
  return n;
}

std::uint32_t PrototypeStore::observations(std::uint32_t landmark) const {
  std::uint32_t n = 0;
  for (std::uint32_t row = first_row(landmark); row != kNone; row = next_row(row)) {
    n += counts_[row];
  }
  return n;
}

void PrototypeStore::visit_sorted_landmarks(const Visit& visit) const {
  std::int64_t largest = -1;
  bool ascending = true;
  for (const std::int64_t id : ids_) {
    ascending = ascending && (id < 0 || id > largest);
    largest = std::max(largest, id);
  }
  // To ask for all that there may be is quicker than to sort those that are there.
  if (!ascending && static_cast<std::size_t>(largest) < 2 * landmarks()) {
    constexpr std::size_t kPiece = 1 << 13;
    std::vector<std::uint32_t> piece;
    for (std::int64_t id = 0; id <= largest; ++id) {
      if (const std::uint32_t landmark = find(id); landmark != kNone) piece.push_back(landmark);
      if (piece.size() < kPiece && id < largest) continue;
      visit(piece);
      piece.clear();
    }
    return;
  }
  const auto each = [&](const auto& take) {
    for (std::uint32_t i = 0; i < ids_.size(); ++i) {
      if (ids_[i] >= 0) take(i);
    }
  };
  visit_sorted(landmarks(), each, [&](std::uint32_t i) { return ids_[i]; }, visit);
}

void PrototypeStore::visit_sorted_rows(std::uint32_t cell, const Visit& visit) const {
  visit_sorted(
      blocks_.rows(cell),
      [&](const auto& take) { blocks_.each_row(cell, [&](auto row) { take(row.value); }); },
      [&](std::uint32_t row) { return std::pair(ids_[landmark_of(row)], look(row)); }, visit);
}

std::vector<std::uint32_t> PrototypeStore::sorted_landmarks() const {
  std::vector<std::uint32_t> result;
  result.reserve(landmarks());
  visit_sorted_landmarks(
      [&](auto piece) { result.insert(result.end(), piece.begin(), piece.end()); });
  return result;
}

std::vector<std::uint32_t> PrototypeStore::rows_at(std::span<const std::size_t> ranks) const {
  std::vector<std::size_t> ascending(ranks.size());
  std::iota(ascending.begin(), ascending.end(), std::size_t{0});
  std::sort(ascending.begin(), ascending.end(),
            [&](std::size_t a, std::size_t b) { return ranks[a] < ranks[b]; });
  std::vector<std::uint32_t> result(ranks.size());
  std::size_t seen = 0;
  auto next = ascending.begin();
  visit_sorted_landmarks([&](std::span<const std::uint32_t> landmarks) {
    const std::vector<std::uint32_t> rows = sorted_rows(landmarks);
    for (; next != ascending.end() && ranks[*next] < seen + rows.size(); ++next) {
      result[*next] = rows[ranks[*next] - seen];
    }
    seen += rows.size();
  });
  return result;
}

std::vector<std::uint32_t> PrototypeStore::sorted_rows(
    std::span<const std::uint32_t> landmarks) const {
  if (look_bits_ == 0) return {landmarks.begin(), landmarks.end()};
  std::size_t rows = 0;
  for (const std::uint32_t landmark : landmarks) rows += rows_of(landmark);
  std::vector<std::uint32_t> all;
  all.reserve(rows);
  for (const std::uint32_t landmark : landmarks) {
    const auto own = sorted_rows(landmark);
    all.insert(all.end(), own.begin(), own.end());
  }
  return all;
}

std::vector<std::uint32_t> PrototypeStore::sorted_rows(std::uint32_t landmark) const {
  std::vector<std::uint32_t> result;
  for (std::uint32_t row = first_row(landmark); row != kNone; row = next_row(row)) {
    result.push_back(row);
  }
  std::sort(result.begin(), result.end(),
            [&](std::uint32_t a, std::uint32_t b) { return look(a) < look(b); });
  return result;
}

void PrototypeStore::rounded(std::uint32_t row, std::int8_t* to) const {
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::copy_n(packed() + packed_index(row, d, dim_), std::min<std::size_t>(4, dim_ - d), to + d);
  }
}

std::vector<std::int8_t> PrototypeStore::rounded(std::span<const std::uint32_t> rows) const {
  std::vector<std::int8_t> result(rows.size() * dim_);
  for (std::size_t i = 0; i < rows.size(); ++i) rounded(rows[i], &result[i * dim_]);
  return result;
}

// A row's key is looked up again before it moves: its number may have changed by the move of
// another.
void PrototypeStore::settle(int threads) {
  const auto find_key = [&](const Key& key) {
    const std::uint32_t landmark = find(key.id);
    return landmark == kNone ? kNone : find_row(landmark, key.look);
  };
  std::vector<Key> keys;
  std::vector<std::uint32_t> rows;
  for (std::size_t first = 0; first < unsettled_.size(); first += kSettleChunk) {
    keys.clear();
    rows.clear();
    const std::size_t end = std::min(first + kSettleChunk, unsettled_.size());
    for (std::size_t i = first; i < end; ++i) {
      const std::uint32_t row = find_key(unsettled_[i]);
      if (row == kNone) continue;
      keys.push_back(unsettled_[i]);
      rows.push_back(row);
    }
    const std::vector<std::int8_t> codes = rounded(rows);
    std::vector<std::uint32_t> cells = cells_.assign({codes.data(), rows.size(), dim_}, threads);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (blocks_.list_of({rows[i]}) == cells[i]) cells[i] = kNone;
    }
    for (std::size_t i = 0; i < keys.size(); ++i) {
      if (cells[i] == kNone) continue;
      const std::uint32_t row = find_key(keys[i]);
      if (blocks_.list_of({row}) == cells[i]) continue;  // it was there twice
      relocate(row, take_place(cells[i]));
      close_gap(row);
    }
  }
  changes_ += unsettled_.size();
  unsettled_.clear();
}

void PrototypeStore::make_room_for_positions(const Alone& alone) {
  if (!positions_.empty()) return;
  std::vector<Position> fresh(ids_.size(), kNowhere);
  alone([&] { positions_.swap(fresh); });
}

void PrototypeStore::set_position(std::uint32_t landmark, const Position& position) {
  if (positions_.empty()) {
    if (is_nowhere(position)) return;
    positions_.assign(ids_.size(), kNowhere);
  }
  // One NaN for all, so that equal maps give equal files.
  positions_[landmark] = is_nowhere(position) ? kNowhere : position;
  if (uncommitted_) uncommitted_->insert(ids_[landmark]);
}

Position PrototypeStore::position(std::uint32_t landmark) const {
  return positions_.empty() ? kNowhere : positions_[landmark];
}

void PrototypeMap::Store::make_room(std::size_t landmarks, std::size_t rows, std::size_t changed) {
  PrototypeStore::make_room(landmarks, rows, changed, [&](const auto& swap) { alone(swap); });
}

void PrototypeMap::Store::make_room_for_positions() {
  PrototypeStore::make_room_for_positions([&](const auto& swap) { alone(swap); });
}

void PrototypeMap::Store::alone(const std::function<void()>& swap) {
  const std::unique_lock lock(mutex);
  swap();
}

// What was there before goes when the lock has.
void PrototypeMap::Store::put_into_cells(CoarseQuantizer cells, int threads, bool in_place) {
  Arrangement to = arrange(std::move(cells), threads);
  if (in_place) {
    make_places(to.places(), [&](const auto& swap) { alone(swap); });
    alone([&] { rearrange(to); });
    return;
  }
  PrototypeStore other = arranged(to);
  alone([&] {
    other.take_notes_of(*this);
    std::swap(static_cast<PrototypeStore&>(*this), other);
  });
}

PackedPrototypes PrototypeStore::view() const {
  static_assert(sizeof(LandmarkIndex) == sizeof(std::uint32_t));
  PackedPrototypes result{packed(), places(), dim_};
  result.landmarks.ids = ids_.data();
  if (look_bits_ != 0) {
    result.landmarks.of_row = reinterpret_cast<const LandmarkIndex*>(owners_.data());
  }
  return result;
}

}  // namespace protomark
