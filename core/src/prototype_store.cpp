#include "prototype_store.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "protomark/error.h"

namespace protomark {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr Position kNowhere = {kNaN, kNaN, kNaN};

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
  ids_.reserve(landmarks);
  sums_.reserve(rows * dim_);
  counts_.reserve(rows);
  packed_.reserve(packed_size(rows, dim_));
  if (look_bits_ == 0) return;
  heads_.reserve(landmarks);
  looks_.reserve(rows);
  owners_.reserve(rows);
  next_.reserve(rows);
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
  if (rows() >= kNone) throw std::length_error("a map holds under 2^32 prototypes");
  const auto landmark = static_cast<std::uint32_t>(landmarks());
  make_room(ids_, 1);
  make_room(positions_, 1);
  make_room(heads_, 1);
  ids_.push_back(id);
  try {
    index_.insert(ids_, landmark);
  } catch (...) {
    ids_.pop_back();
    throw;
  }
  if (!positions_.empty()) positions_.push_back(kNowhere);
  if (look_bits_ != 0) heads_.push_back(kNone);
  return landmark;
}

void PrototypeStore::make_room_for_row() {
  make_room(sums_, dim_);
  make_room(counts_, 1);
  make_room(packed_, packed_size(rows() + 1, dim_) - packed_.size());
  if (look_bits_ == 0) return;
  make_room(looks_, 1);
  make_room(owners_, 1);
  make_room(next_, 1);
}

std::uint32_t PrototypeStore::create_row(std::uint32_t landmark, std::uint16_t look) {
  if (rows() >= kNone) throw std::length_error("a map holds under 2^32 prototypes");
  make_room_for_row();
  const auto row = static_cast<std::uint32_t>(rows());
  sums_.resize(sums_.size() + dim_, 0);
  counts_.push_back(0);
  packed_.resize(packed_size(rows(), dim_), 0);
  if (look_bits_ != 0) {
    looks_.push_back(look);
    owners_.push_back(landmark);
    next_.push_back(heads_[landmark]);
    heads_[landmark] = row;
  }
  return row;
}

// The head or link that leads to a row.
std::uint32_t* PrototypeStore::link_to(std::uint32_t row) {
  std::uint32_t* link = &heads_[owners_[row]];
  while (*link != row) link = &next_[*link];
  return link;
}

// The last row takes the place of another one.
void PrototypeStore::move_last_row(std::uint32_t to) {
  const auto last = static_cast<std::uint32_t>(rows() - 1);
  if (to != last) {
    std::copy_n(sum(last), dim_, sum(to));
    counts_[to] = counts_[last];
    if (look_bits_ != 0) {
      *link_to(last) = to;
      next_[to] = next_[last];
      looks_[to] = looks_[last];
      owners_[to] = owners_[last];
    }
    refresh(to);
  }
  for (std::size_t d = 0; d < dim_; ++d) packed_[packed_index(last, d, dim_)] = 0;
  sums_.resize(sums_.size() - dim_);
  counts_.pop_back();
  packed_.resize(packed_size(rows(), dim_));
  if (look_bits_ != 0) {
    looks_.pop_back();
    owners_.pop_back();
    next_.pop_back();
  }
}

// The last landmark takes the place of another one.
void PrototypeStore::erase_landmark(std::uint32_t landmark) {
  const auto last = static_cast<std::uint32_t>(landmarks() - 1);
  index_.erase(ids_, ids_[landmark]);
  if (landmark != last) {
    index_.move(ids_, ids_[last], landmark);
    ids_[landmark] = ids_[last];
    if (!positions_.empty()) positions_[landmark] = positions_[last];
    if (look_bits_ != 0) {
      heads_[landmark] = heads_[last];
      for (std::uint32_t row = heads_[landmark]; row != kNone; row = next_[row]) {
        owners_[row] = landmark;
      }
    }
  }
  ids_.pop_back();
  if (!positions_.empty()) positions_.pop_back();
  if (look_bits_ != 0) heads_.pop_back();
}

void PrototypeStore::erase_row(std::uint32_t row) {
  const std::uint32_t landmark = landmark_of(row);
  if (look_bits_ != 0) *link_to(row) = next_[row];
  move_last_row(row);
  if (look_bits_ == 0 || heads_[landmark] == kNone) erase_landmark(landmark);
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
  std::vector<std::uint32_t> result(landmarks());
  std::iota(result.begin(), result.end(), 0u);
  std::sort(result.begin(), result.end(),
            [&](std::uint32_t a, std::uint32_t b) { return ids_[a] < ids_[b]; });
  return result;
}

std::vector<std::uint32_t> PrototypeStore::sorted_rows() const {
  std::vector<std::uint32_t> result = sorted_landmarks();
  if (look_bits_ == 0) return result;
  std::vector<std::uint32_t> all;
  all.reserve(rows());
  for (const std::uint32_t landmark : result) {
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

void PrototypeStore::add(std::uint32_t row, const std::int8_t* code) {
  std::int16_t* s = sum(row);
  if (counts_[row] == PrototypeMap::kMaxCount) {
    for (std::size_t d = 0; d < dim_; ++d) s[d] = static_cast<std::int16_t>(s[d] / 2);
    counts_[row] /= 2;
  }
  for (std::size_t d = 0; d < dim_; ++d) s[d] = static_cast<std::int16_t>(s[d] + code[d]);
  ++counts_[row];
}

void PrototypeStore::join(std::uint32_t row, const std::int16_t* other, int other_count) {
  const int n = counts_[row] + other_count;
  const int halvings = n > PrototypeMap::kMaxCount ? 1 : 0;  // 255 + 255 needs one at most
  std::int16_t* s = sum(row);
  for (std::size_t d = 0; d < dim_; ++d) {
    const int total = s[d] + other[d];
    s[d] = static_cast<std::int16_t>(halvings != 0 ? total / 2 : total);
  }
  counts_[row] = static_cast<std::uint8_t>(n >> halvings);
  refresh(row);
}

void PrototypeStore::refresh(std::uint32_t row) {
  for (std::size_t d = 0; d < dim_; ++d) {
    packed_[packed_index(row, d, dim_)] = rounded_mean<int>(sum(row)[d], counts_[row]);
  }
}

void PrototypeStore::set_position(std::uint32_t landmark, const Position& position) {
  if (positions_.empty()) {
    if (is_nowhere(position)) return;
    positions_.assign(landmarks(), kNowhere);
  }
  positions_[landmark] = position;
}

Position PrototypeStore::position(std::uint32_t landmark) const {
  return positions_.empty() ? kNowhere : positions_[landmark];
}

PackedPrototypes PrototypeStore::view() const {
  PackedPrototypes result{packed_.data(), rows(), dim_, ids_.data()};
  if (look_bits_ != 0) result.landmarks.of_row = owners_.data();
  return result;
}

}  // namespace protomark
