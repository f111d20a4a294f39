#include "prototype_store.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <utility>

#include "protomark/error.h"
#include "rounded_mean.h"

namespace protomark {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr Position kNowhere = {kNaN, kNaN, kNaN};
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

void PrototypeStore::reserve(std::size_t landmarks, std::size_t rows) {
  const std::size_t blocks = (rows + kPackedRows - 1) / kPackedRows, places = blocks * kPackedRows;
  ids_.reserve(look_bits_ == 0 ? places : landmarks);
  sums_.reserve(places * dim_);
  counts_.reserve(places);
  packed_.reserve(packed_size(places, dim_) / sizeof(CodeVector));
  blocks_.reserve(blocks);
  if (look_bits_ == 0) return;
  heads_.reserve(landmarks);
  looks_.reserve(places);
  owners_.reserve(places);
  next_.reserve(places);
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

// Room for more elements, growing as push_back does, so that adding them cannot fail half-way.
template <typename T, typename Allocator>
void make_room(std::vector<T, Allocator>& v, std::size_t more) {
  if (v.capacity() - v.size() < more) v.reserve(std::max(2 * v.capacity(), v.size() + more));
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
    make_room(ids_, 1);
    make_room(positions_, 1);
    make_room(heads_, 1);
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
  constexpr std::size_t kRows = kPackedRows;
  blocks_.make_room();
  make_room(sums_, kRows * dim_);
  make_room(counts_, kRows);
  make_room(packed_, packed_size(kRows, dim_) / sizeof(CodeVector));
  if (look_bits_ == 0) {
    make_room(ids_, kRows);
    if (!positions_.empty()) make_room(positions_, kRows);
    return;
  }
  make_room(looks_, kRows);
  make_room(owners_, kRows);
  make_room(next_, kRows);
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
  const std::uint32_t row = blocks_.append(cell);
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
  while (*link != row) link = &next_[*link];
  return link;
}

// A row moves to a place that is free and leaves its own free.
void PrototypeStore::relocate(std::uint32_t from, std::uint32_t to) {
  std::copy_n(sum(from), dim_, sum(to));
  counts_[to] = counts_[from];
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::copy_n(packed() + packed_index(from, d, dim_), 4, packed() + packed_index(to, d, dim_));
  }
  if (look_bits_ == 0) {
    index_.move(ids_, ids_[from], to);
    ids_[to] = std::exchange(ids_[from], -1);
    if (!positions_.empty()) positions_[to] = std::exchange(positions_[from], kNowhere);
  } else {
    *link_to(from) = to;
    next_[to] = next_[from];
    looks_[to] = looks_[from];
    owners_[to] = std::exchange(owners_[from], kNone);
  }
}

// The last row of its cell takes the place of a row that is gone; where a block becomes empty, the
// last block takes its place.
void PrototypeStore::close_gap(std::uint32_t row) {
  if (look_bits_ == 0) {
    ids_[row] = -1;
    if (!positions_.empty()) positions_[row] = kNowhere;
  } else {
    owners_[row] = kNone;
  }
  const std::uint32_t cell = blocks_.cell_of(row);
  if (const std::uint32_t last = blocks_.last(cell); last != row) relocate(last, row);
  const std::uint32_t gone = blocks_.pop(cell);
  --rows_;
  ++changes_;
  if (gone == CellBlocks::kNone) return;
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

std::vector<std::uint32_t> PrototypeStore::sorted_landmarks() const {
  std::vector<std::uint32_t> result;
  result.reserve(landmarks());
  for (std::uint32_t i = 0; i < ids_.size(); ++i) {
    if (ids_[i] >= 0) result.push_back(i);
  }
  std::sort(result.begin(), result.end(),
            [&](std::uint32_t a, std::uint32_t b) { return ids_[a] < ids_[b]; });
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

// In a large map nearly everything here waits for memory, so that is asked for ahead.
void PrototypeStore::add(std::span<const std::int64_t> landmarks, Codes codes) {
  constexpr std::size_t kChunk = 512, kAhead = 16;
  std::array<std::uint32_t, kChunk> rows;
  for (std::size_t first = 0; first < landmarks.size(); first += kChunk) {
    const std::size_t n = std::min(kChunk, landmarks.size() - first);
    const std::int64_t* ids = &landmarks[first];
    std::size_t found = 0, added = 0;
    const auto add_to = [&](std::size_t end) {
      for (; added < end; ++added) add(rows[added], codes.row(first + added));
    };
    const auto finish = [&] {
      add_to(found);
      for (std::size_t i = 0; i < found; ++i) {
        if (i + kAhead < found) prefetch_rounded(rows[i + kAhead]);
        if (i + 1 == found || rows[i] != rows[i + 1]) refresh(rows[i]);
      }
    };
    for (std::size_t i = 0; i < std::min(n, 2 * kAhead); ++i) index_.prefetch_slot(ids[i]);
    try {
      for (; found < n; ++found) {
        if (found + 2 * kAhead < n) index_.prefetch_slot(ids[found + 2 * kAhead]);
        if (found + kAhead < n) index_.prefetch_id(ids_, ids[found + kAhead]);
        rows[found] = find_or_create_row(ids[found], look_of(codes.row(first + found)));
        __builtin_prefetch(sum(rows[found]), 1);
        __builtin_prefetch(sum(rows[found]) + dim_ - 1, 1);
        __builtin_prefetch(&counts_[rows[found]], 1);
        if (found >= kAhead) add_to(found - kAhead);
      }
    } catch (...) {
      // Out of memory half-way: what was added stays, and answers.
      finish();
      throw;
    }
    finish();
  }
}

void PrototypeStore::prefetch_rounded(std::uint32_t row) const {
  for (std::size_t d = 0; d < dim_; d += 4) {
    __builtin_prefetch(packed() + packed_index(row, d, dim_), 1);
  }
}

namespace {

// Half of a sum, of which `count` observations are left: a mean of 127 stays one, although half of
// an odd count is rounded down.
std::int16_t half(int sum, int count) {
  return static_cast<std::int16_t>(std::clamp(sum / 2, -127 * count, 127 * count));
}

}  // namespace

void PrototypeStore::add(std::uint32_t row, const std::int8_t* code) {
  std::int16_t* s = sum(row);
  if (counts_[row] == PrototypeMap::kMaxCount) {
    counts_[row] /= 2;
    for (std::size_t d = 0; d < dim_; ++d) s[d] = half(s[d], counts_[row]);
  }
  for (std::size_t d = 0; d < dim_; ++d) s[d] = static_cast<std::int16_t>(s[d] + code[d]);
  ++counts_[row];
}

void PrototypeStore::join(std::uint32_t row, const std::int16_t* other, int other_count) {
  const int n = counts_[row] + other_count;
  const bool halved = n > PrototypeMap::kMaxCount;  // once is enough for 255 + 255
  counts_[row] = static_cast<std::uint8_t>(halved ? n / 2 : n);
  std::int16_t* s = sum(row);
  for (std::size_t d = 0; d < dim_; ++d) {
    const int total = s[d] + other[d];
    s[d] = halved ? half(total, counts_[row]) : static_cast<std::int16_t>(total);
  }
  refresh(row);
}

void PrototypeStore::refresh(std::uint32_t row) {
  std::array<std::int8_t, 256> mean;
  rounded_means(sum(row), counts_[row], dim_, mean.data());
  bool changed = false;
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::int8_t* to = packed() + packed_index(row, d, dim_);
    const std::size_t n = std::min<std::size_t>(4, dim_ - d);
    changed = changed || std::memcmp(to, &mean[d], n) != 0;
    std::memcpy(to, &mean[d], n);
  }
  if (uncommitted_) uncommitted_->insert(ids_[landmark_of(row)]);
  if (changed && cells_.size() != 0) unsettled_.push_back({ids_[landmark_of(row)], look(row)});
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
      if (blocks_.cell_of(rows[i]) == cells[i]) cells[i] = kNone;
    }
    for (std::size_t i = 0; i < keys.size(); ++i) {
      if (cells[i] == kNone) continue;
      const std::uint32_t row = find_key(keys[i]);
      if (blocks_.cell_of(row) == cells[i]) continue;  // it was there twice
      relocate(row, take_place(cells[i]));
      close_gap(row);
    }
  }
  changes_ += unsettled_.size();
  unsettled_.clear();
}

void PrototypeStore::set_cells(Cells cells, int threads) {
  std::vector<std::uint32_t> rows;
  rows.reserve(rows_);
  for (std::uint32_t row = 0; row < places(); ++row) {
    if (is_row(row)) rows.push_back(row);
  }
  std::vector<std::uint32_t> cell_of_row(rows.size(), 0);
  for (std::size_t first = 0; cells.size() != 0 && first < rows.size(); first += kSettleChunk) {
    const auto some = std::span(rows).subspan(first, std::min(kSettleChunk, rows.size() - first));
    const std::vector<std::int8_t> codes = rounded(some);
    const auto own = cells.assign({codes.data(), some.size(), dim_}, threads);
    std::copy(own.begin(), own.end(), cell_of_row.begin() + static_cast<std::ptrdiff_t>(first));
  }
  rearrange(rows, cell_of_row, std::max<std::size_t>(cells.size(), 1));
  cells_ = std::move(cells);
  unsettled_.clear();
  changes_ += rows_;
  if (uncommitted_) uncommitted_->cells = true;
}

namespace {

// Elements of `size` values that are to go from one place to another one. The room is taken first,
// and not touched until they go, so that they do all or, where memory runs out, none, and take no
// more than twice the largest array's.
template <typename Vector>
class MovedElements {
 public:
  MovedElements(Vector& v, std::size_t size, std::size_t places,
                const typename Vector::value_type& padding)
      : from_(v), size_(size), places_(v.empty() ? 0 : places), padding_(padding) {
    to_.reserve(places_ * size_);
  }

  void move(const std::vector<std::uint32_t>& from, const std::vector<std::uint32_t>& to) {
    to_.resize(places_ * size_, padding_);
    for (std::size_t i = 0; places_ != 0 && i < from.size(); ++i) {
      std::copy_n(&from_[from[i] * size_], size_, &to_[to[i] * size_]);
    }
    from_ = std::move(to_);
  }

 private:
  Vector& from_;
  Vector to_;
  std::size_t size_, places_;
  typename Vector::value_type padding_;
};

}  // namespace

// Puts all rows into the blocks of these cells.
void PrototypeStore::rearrange(const std::vector<std::uint32_t>& rows,
                               const std::vector<std::uint32_t>& cell_of_row, std::size_t cells) {
  const CellOrder order(cell_of_row, cells);
  const std::vector<std::uint32_t>& to = order.places;
  const std::size_t end = order.first_blocks.back() * kPackedRows;
  CellBlocks blocks(cells);
  blocks.reserve(order.first_blocks.back());
  for (std::uint32_t c = 0; c < cells; ++c) {
    for (std::size_t i = 0; i < order.rows[c]; ++i) blocks.append(c);
  }
  std::vector<std::uint32_t> number(places(), kNone);
  for (std::size_t i = 0; i < rows.size(); ++i) number[rows[i]] = to[i];
  MovedElements sums(sums_, dim_, end, std::int16_t{0});
  MovedElements counts(counts_, 1, end, std::uint8_t{0});
  const std::size_t landmarks = look_bits_ == 0 ? end : 0;
  MovedElements ids(ids_, 1, landmarks, std::int64_t{-1});
  MovedElements positions(positions_, 1, landmarks, kNowhere);
  MovedElements looks(looks_, 1, end, std::uint16_t{0});
  MovedElements owners(owners_, 1, end, std::uint32_t{kNone});
  MovedElements next(next_, 1, end, std::uint32_t{kNone});
  LargeVector<CodeVector> packed(packed_size(end, dim_) / sizeof(CodeVector));

  // From here on nothing asks for memory.
  auto* codes = reinterpret_cast<std::int8_t*>(packed.data());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    for (std::size_t d = 0; d < dim_; d += 4) {
      std::memcpy(codes + packed_index(to[i], d, dim_),
                  this->packed() + packed_index(rows[i], d, dim_), 4);
    }
  }
  packed_ = std::move(packed);
  blocks_ = std::move(blocks);
  sums.move(rows, to);
  counts.move(rows, to);
  if (look_bits_ == 0) {
    ids.move(rows, to);
    positions.move(rows, to);
    index_.renumber(number);
    return;
  }
  looks.move(rows, to);
  owners.move(rows, to);
  next.move(rows, to);
  for (auto* links : {&heads_, &next_}) {
    for (std::uint32_t& row : *links) {
      if (row != kNone) row = number[row];
    }
  }
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

PackedPrototypes PrototypeStore::view() const {
  PackedPrototypes result{packed(), places(), dim_, ids_.data()};
  if (look_bits_ != 0) result.landmarks.of_row = owners_.data();
  return result;
}

}  // namespace protomark
