#include "map/prototype_store.h"

#include <algorithm>
#include <bit>
#include <cstring>
#include <mutex>
#include <numeric>

#include "base/quantize.h"
#include "base/sorted_pieces.h"
#include "map/positions.h"
#include "protomark/prototype_map.h"

namespace protomark {
namespace {

// Adding to a large map mostly waits for memory: prefetches it this many observations ahead.
constexpr std::size_t kAhead = 16;

// Eight numbers, and from a byte each.
typedef std::int16_t Eight __attribute__((vector_size(16)));
typedef std::int8_t EightBytes __attribute__((vector_size(8)));
Eight eight(std::uint64_t bytes) {
  return __builtin_convertvector(std::bit_cast<EightBytes>(bytes), Eight);
}

template <typename T>
T load(const void* from) {
  T value;
  std::memcpy(&value, from, sizeof(value));
  return value;
}
template <typename T>
void store(void* to, const T& value) {
  std::memcpy(to, &value, sizeof(value));
}

// Halves a sum of which `count` observations are left. A mean of 127 stays one, although half of an
// odd count is rounded down.
std::int16_t half(int sum, int count) {
  return static_cast<std::int16_t>(std::clamp(sum / 2, -127 * count, 127 * count));
}

}  // namespace

std::size_t PrototypeStore::row_bytes() const {
  return rest_bytes_ + packed_dim(dim_) + sizeof(counts_[0]) + RowTable::row_bytes();
}

void PrototypeStore::reserve(std::size_t landmarks, std::size_t rows) {
  // One more block, as take_row wants one to be free.
  const std::size_t blocks = (rows + kPackedRows - 1) / kPackedRows + 1;
  for_each_array(landmarks, blocks * kPackedRows,
                 [](auto& v, std::size_t n, const auto&) { v.reserve(n); });
  lists_.reserve(blocks);
}

void PrototypeStore::make_room(std::size_t landmarks, std::size_t rows, std::size_t changed,
                               FairSharedMutex& searching) {
  // New rows begin in the first list, and each that moves may begin a block.
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
  LandmarkIndex landmark = find(id);
  const Row row = landmark == kNoLandmark ? kNoRow : find_row(landmark, appearance);
  return row != kNoRow ? row : create_row(id, landmark, appearance);
}

Row PrototypeStore::create_row(std::int64_t id, LandmarkIndex& landmark, std::uint16_t appearance) {
  if (landmark == kNoLandmark) make_room_for_landmark();
  const Row row = take_row(0);
  if (landmark != kNoLandmark) {
    add_row(landmark, row, appearance);
  } else {
    add_landmark(id, row, appearance);
    landmark = owner(row);
  }
  return row;
}

// Makes room for a row at the end of a list.
Row PrototypeStore::take_row(std::uint32_t list) {
  if (row_end() + kPackedRows > UINT32_MAX) {
    throw std::length_error("a map holds under 2^32 prototypes");
  }
  lists_.make_room();
  slots_.make_room();
  for_each_array(0, kPackedRows,
                 [](auto& v, std::size_t more, const auto&) { make_room_in(v, more); });
  const Row row = lists_.append(list);
  if (row_end() != counts_.size()) resize(row_end());
  ++prototype_count_;
  // No prototype has this number, so the first one differs.
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

// Moves the last row of a list to where one was removed, and the last of all blocks to a block that
// this empties.
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
  if (has_slot(row)) slots_.give_back(slot(row));
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
  for (Row row = first_row(landmark); row != kNoRow; row = next_row(row)) n += counts_[row.value];
  return n;
}

MapSummary PrototypeStore::summary() const {
  MapSummary result;
  each_landmark([&](LandmarkIndex l) { add_to_summary(result, observations(l), position(l)); });
  return result;
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
  const auto each = [&](const auto& take) { each_landmark(take); };
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

void PrototypeStore::find_rows(std::span<const std::int64_t> ids, Codes codes,
                               std::span<Row> rows) const {
  const std::size_t n = rows.size();
  for (std::size_t i = 0; i < n + 2 * kAhead; ++i) {
    if (i < n) index_.prefetch_slot(ids[i]);
    if (i >= kAhead && i < n + kAhead) index_.prefetch_ids(ids_, ids[i - kAhead]);
    if (i < 2 * kAhead) continue;
    const std::size_t at = i - 2 * kAhead;
    const LandmarkIndex landmark = find(ids[at]);
    rows[at] = landmark == kNoLandmark ? kNoRow : find_row(landmark, appearance_of(codes.row(at)));
  }
}

void PrototypeStore::add(std::span<const std::int64_t> ids, Codes codes,
                         std::span<const Row> rows) {
  const std::size_t n = rows.size();
  if (quantizer_.nlist() != 0) to_reassign_.reserve(to_reassign_.size() + n);
  // Neighbours of the same row are added at once.
  for (std::size_t i = 0, end = 0; i < n + kAhead; ++i) {
    if (i < n && rows[i] != kNoRow) prefetch(rows[i]);
    const std::size_t nearer = i - kAhead / 2;
    if (nearer < n && rows[nearer] != kNoRow) prefetch_slot(rows[nearer]);
    if (i < end + kAhead) continue;
    const std::size_t at = end++;
    if (rows[at] == kNoRow) continue;
    while (end < n && rows[end] == rows[at]) ++end;
    add(rows[at], codes.row(at), end - at);
  }
  // If memory runs out, what was added so far stays, and answers.
  for (std::size_t i = 0, end = 0; i < n; i = end) {
    end = i + 1;
    if (rows[i] != kNoRow) continue;
    const std::uint16_t appearance = appearance_of(codes.row(i));
    while (end < n && ids[end] == ids[i] && appearance_of(codes.row(end)) == appearance) ++end;
    add(find_or_create_row(ids[i], appearance), codes.row(i), end - i);
  }
}

// Adds n codes.
void PrototypeStore::add(Row row, const std::int8_t* codes, std::size_t n) {
  Sum s = sum(row);
  int count = counts_[row.value];
  for (const std::int8_t* code = codes; code != codes + n * dim_; code += dim_) {
    if (count == PrototypeMap::kMaxCount) {
      count /= 2;
      for (std::size_t d = 0; d < dim_; ++d) s[d] = half(s[d], count);
    }
    // A caller may write over codes that were checked: even then no sum is impossible.
    for (std::size_t d = 0; d < dim_; ++d) {
      s[d] = static_cast<std::int16_t>(s[d] + std::max<std::int16_t>(code[d], -127));
    }
    ++count;
  }
  set(row, s, count);
}

void PrototypeStore::merge(Row row, const Sum& other, int other_count) {
  const int total = count(row) + other_count;
  const bool halved = total > PrototypeMap::kMaxCount;  // once is enough for 255 + 255
  const int n = halved ? total / 2 : total;
  Sum s = sum(row);
  for (std::size_t d = 0; d < dim_; ++d) {
    const int both = s[d] + other[d];
    s[d] = halved ? half(both, n) : static_cast<std::int16_t>(both);
  }
  set(row, s, n);
}

void PrototypeStore::merge(std::int64_t id, const PrototypeStore& from, LandmarkIndex landmark) {
  for (Row row = from.first_row(landmark); row != kNoRow; row = from.next_row(row)) {
    merge(find_or_create_row(id, from.appearance(row)), from.sum(row), from.count(row));
  }
  const LandmarkIndex into = at(id);
  if (!has_position(position(into))) set_position(into, from.position(landmark));
}

Sum PrototypeStore::sum(Row row) const {
  // Copies of members, which the compiler cannot know to stay.
  const std::size_t dim = dim_;
  const std::int8_t* means = packed() + packed_index(row.value, 0, dim);
  const std::uint8_t* in_row = rest(row);
  const auto n = static_cast<std::int16_t>(counts_[row.value]);
  const std::int8_t* in_slot = has_slot(row) ? slots_[slot(row)] : nullptr;
  Sum sum;
  for (std::size_t d = 0; d < dim; d += 8, means += 8 * kPackedRows) {
    std::uint64_t mean = load<std::uint32_t>(means);
    if (d + 4 < dim) mean |= std::uint64_t{load<std::uint32_t>(means + 4 * kPackedRows)} << 32;
    Eight left;
    if (in_slot != nullptr) {
      left = eight(load<std::uint64_t>(in_slot + d));
    } else {
      const std::uint64_t halves = load<std::uint32_t>(in_row + d / 2);
      left = (eight((halves | halves << 28) & 0x0f0f0f0f0f0f0f0f) ^ 8) - 8;
    }
    store(&sum[d], n * eight(mean) + left);
  }
  return sum;
}

void PrototypeStore::set(Row row, const Sum& sum, int count) {
  const bool had_slot = has_slot(row), needs_slot = count > kMaxSmallCount;
  if (needs_slot && !had_slot) {
    store(rest(row), slots_.take());
  } else if (had_slot && !needs_slot) {
    slots_.give_back(slot(row));
  }
  std::int8_t* in_slot = needs_slot ? slots_[slot(row)] : nullptr;
  std::uint8_t* in_row = rest(row);
  counts_[row.value] = static_cast<std::uint8_t>(count);
  const auto n = static_cast<std::int16_t>(count);
  const std::size_t dim = dim_;
  std::array<std::int8_t, 256> means;
  rounded_means(sum.data(), count, (dim + 7) / 8 * 8, means.data());
  for (std::size_t d = 0; d < dim; d += 8) {
    const Eight left = load<Eight>(&sum[d]) - n * eight(load<std::uint64_t>(&means[d]));
    if (in_slot != nullptr) {
      store(in_slot + d, __builtin_convertvector(left, EightBytes));
    } else {
      const auto [low, high] = std::bit_cast<std::array<std::uint64_t, 2>>(left & 15);
      const std::uint64_t pairs = low | high << 4, bytes = (pairs | pairs >> 8) & 0xffff0000ffff;
      store(in_row + d / 2, static_cast<std::uint32_t>(bytes | bytes >> 16));
    }
  }
  std::uint32_t differences = 0;
  std::int8_t* at = packed() + packed_index(row.value, 0, dim);
  for (std::size_t d = 0; d < dim; d += 4, at += 4 * kPackedRows) {
    std::uint32_t before, after;
    std::memcpy(&before, at, 4);
    std::memcpy(&after, &means[d], 4);
    std::memcpy(at, &after, 4);
    differences |= before ^ after;
  }
  if (uncommitted) uncommitted->insert(id(owner(row)));
  if (differences != 0 && quantizer_.nlist() != 0) {
    to_reassign_.push_back({id(owner(row)), appearance(row)});
  }
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
