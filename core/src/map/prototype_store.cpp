#include "map/prototype_store.h"

#include <numeric>

#include "protomark/prototype_map.h"

namespace protomark {
namespace {

// Adding to a large map mostly waits for memory: prefetches it this many observations ahead.
constexpr size_t kAhead = 16;

// Rows that are assigned to lists at a time, and those that are moved at a time.
constexpr size_t kAssignChunk = 1 << 14, kReassignChunk = 1 << 16;

// Eight numbers, and from a byte each.
typedef int16_t Eight __attribute__((vector_size(16)));
typedef int8_t EightBytes __attribute__((vector_size(8)));
Eight eight(uint64_t bytes) {
  return __builtin_convertvector(std::bit_cast<EightBytes>(bytes), Eight);
}

// Halves a sum of which `count` observations, rounded down, are left; the mean stays within 127.
int16_t half(int sum, int count) {
  return static_cast<int16_t>(std::clamp(sum / 2, -127 * count, 127 * count));
}

}  // namespace

void PrototypeStore::make_room(size_t landmarks, size_t rows, size_t changed,
                               FairSharedMutex& searching) {
  // New rows begin in the first list, and each that moves may begin a block.
  const size_t moving = quantizer_.nlist() == 0 ? 0 : std::min(changed, quantizer_.nlist());
  const size_t blocks = 2 * packed_blocks(rows) + moving;
  for_each_array(landmarks, blocks * kPackedRows, [&](auto& v, size_t more, const auto&) {
    enlarge(v, capacity_for(v, more), searching);
  });
  if (!index_.has_room(landmarks)) {
    IdIndex larger = index_.with_room(ids_, landmarks);
    const std::unique_lock lock(searching);
    std::swap(index_, larger);
  }
}

Row PrototypeStore::take_row(uint32_t list) {
  if (row_end() + kPackedRows > UINT32_MAX) {
    throw std::length_error("a map holds under 2^32 prototypes");
  }
  lists_.make_room();
  slots_.make_room();
  for_each_array(0, kPackedRows,
                 [](auto& v, size_t more, const auto&) { v.reserve(capacity_for(v, more)); });
  const Row row = lists_.append(list);
  if (row_end() != counts_.size()) resize(row_end());
  ++prototype_count_;
  // No prototype has this number, so the first one differs.
  packed()[packed_index(row.value, 0, dim_)] = -128;
  return row;
}

void PrototypeStore::copy_row(Row from, Row to) {
  for_each_plain_array(0, 1, [&](auto& v, size_t width, const auto&) {
    std::copy_n(v.data() + from.value * width, width, v.data() + to.value * width);
  });
  copy_packed(from, packed(), to.value);
}

// Moves the last row of the list to the gap, and the last of all blocks to a block that is empty.
void PrototypeStore::close_gap(Row row) {
  vacate(row);
  const uint32_t list = lists_.list_of(row);
  if (const Row last = lists_.last(list); last != row) relocate(last, row);
  const uint32_t emptied = lists_.pop(list);
  --prototype_count_;
  ++changes_;
  if (emptied == ListBlocks::kNone) return;
  const size_t moved = lists_.blocks();
  for (size_t i = 0; emptied != moved && i < kPackedRows; ++i) {
    const Row from = row_at(moved * kPackedRows + i);
    if (is_row(from)) relocate(from, row_at(emptied * kPackedRows + i));
  }
  resize(row_end());
}

void PrototypeStore::visit_sorted_landmarks(
    const std::function<void(std::span<const LandmarkIndex>)>& visit) const {
  constexpr size_t kPieces = 8, kMinPiece = 1 << 13;
  const size_t n = landmark_count(), piece = std::max(kMinPiece, (n + kPieces - 1) / kPieces);
  const size_t limit = piece + piece / 4;
  const auto id_of = [&](LandmarkIndex landmark) { return id(landmark); };
  std::vector<LandmarkIndex> landmarks;
  landmarks.reserve(std::min(n, limit));
  for (size_t seen = 0; seen < n; seen += landmarks.size()) {
    // Takes the least ids above those of the piece before: up to `end` once there were too many.
    const int64_t last = seen == 0 ? -1 : id(landmarks.back());
    int64_t end = INT64_MAX;
    landmarks.clear();
    each_landmark([&](LandmarkIndex landmark) {
      if (id(landmark) <= last || id(landmark) > end) return;
      landmarks.push_back(landmark);
      if (landmarks.size() < limit || limit >= n) return;
      const auto middle = landmarks.begin() + static_cast<std::ptrdiff_t>(piece - 1);
      std::ranges::nth_element(landmarks, middle, {}, id_of);
      end = id(*middle);
      landmarks.resize(piece);
    });
    std::ranges::sort(landmarks, {}, id_of);
    visit(landmarks);
  }
}

std::vector<Row> PrototypeStore::sorted_rows_at(std::span<const size_t> n) const {
  std::vector<size_t> ascending(n.size());
  std::iota(ascending.begin(), ascending.end(), size_t{0});
  std::ranges::sort(ascending, {}, [&](size_t i) { return n[i]; });
  std::vector<Row> result(n.size());
  size_t seen = 0;
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

void PrototypeStore::find_rows(std::span<const Key> keys, std::span<Row> rows) const {
  constexpr size_t kMany = 64;
  std::vector<size_t> left;  // keys of landmarks with many rows
  for (size_t i = 0; i < keys.size() + 2 * kAhead; ++i) {
    if (i < keys.size()) index_.prefetch_slot(keys[i].id);
    if (i >= kAhead && i - kAhead < keys.size()) index_.prefetch_ids(ids_, keys[i - kAhead].id);
    if (i < 2 * kAhead) continue;
    const size_t at = i - 2 * kAhead;
    const auto [id, wanted] = keys[at];
    const LandmarkIndex landmark = find(id);
    rows[at] = landmark == kNoLandmark ? kNoRow : walk(first_row(landmark), wanted, kMany);
    if (rows[at] == kNoRow || appearance(rows[at]) == wanted) continue;
    rows[at] = kNoRow;
    left.push_back(at);
  }
  // All rows of a landmark once, not once per key.
  const auto key_of = [&](size_t i) { return keys[i]; };
  std::ranges::sort(left, {}, key_of);
  for (size_t i = 0; i < left.size(); ++i) {
    const int64_t id = keys[left[i]].id;
    if (i > 0 && keys[left[i - 1]].id == id) continue;
    each_row_of(find(id), [&](Row row) {
      auto at = std::ranges::lower_bound(left, key(row), {}, key_of);
      for (; at != left.end() && keys[*at] == key(row); ++at) rows[*at] = row;
    });
  }
}

void PrototypeStore::add(std::span<const Key> keys, Codes codes, std::span<const Row> rows) {
  const size_t n = rows.size();
  if (quantizer_.nlist() != 0) to_reassign_.reserve(to_reassign_.size() + n);
  // Neighbours of the same row are added at once.
  for (size_t i = 0, end = 0; i < n + kAhead; ++i) {
    if (i < n && rows[i] != kNoRow) prefetch(rows[i]);
    const size_t nearer = i - kAhead / 2;
    if (nearer < n && rows[nearer] != kNoRow) prefetch_slot(rows[nearer]);
    if (i < end + kAhead) continue;
    const size_t at = end++;
    if (rows[at] == kNoRow) continue;
    while (end < n && rows[end] == rows[at]) ++end;
    add(rows[at], codes.row(at), end - at);
  }
  // If memory runs out, what was added so far stays, and answers.
  size_t created = 0;
  for (size_t i = 0, end = 0; i < n; i = end) {
    end = i + 1;
    if (rows[i] != kNoRow) continue;
    while (end < n && keys[end] == keys[i]) ++end;
    const auto [id, wanted] = keys[i];
    LandmarkIndex landmark = find(id);
    // New rows are the first of their landmark.
    Row row = landmark == kNoLandmark ? kNoRow : walk(first_row(landmark), wanted, created);
    if (row == kNoRow || appearance(row) != wanted) {
      row = create_row(id, landmark, wanted);
      ++created;
    }
    add(row, codes.row(i), end - i);
  }
}

void PrototypeStore::add(Row row, const int8_t* codes, size_t n) {
  Sum s = sum(row);
  int count = counts_[row.value];
  for (const int8_t* code = codes; code != codes + n * dim_; code += dim_) {
    if (count == PrototypeMap::kMaxCount) {
      count /= 2;
      for (size_t d = 0; d < dim_; ++d) s[d] = half(s[d], count);
    }
    // A caller may write over codes that were checked: even then no sum is impossible.
    for (size_t d = 0; d < dim_; ++d) {
      s[d] = static_cast<int16_t>(s[d] + std::max<int16_t>(code[d], -127));
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
  for (size_t d = 0; d < dim_; ++d) {
    const int both = s[d] + other[d];
    s[d] = halved ? half(both, n) : static_cast<int16_t>(both);
  }
  set(row, s, n);
}

Sum PrototypeStore::sum(Row row) const {
  // Copies of members, which the compiler cannot know to stay.
  const size_t dim = dim_;
  const int8_t* means = packed() + packed_index(row.value, 0, dim);
  const uint8_t* in_row = rest(row);
  const auto n = static_cast<int16_t>(counts_[row.value]);
  const int8_t* in_slot = has_slot(row) ? slots_[slot(row)] : nullptr;
  Sum sum;
  for (size_t d = 0; d < dim; d += 8, means += 8 * kPackedRows) {
    uint64_t mean = load<uint32_t>(means);
    if (d + 4 < dim) mean |= uint64_t{load<uint32_t>(means + 4 * kPackedRows)} << 32;
    Eight left;
    if (in_slot != nullptr) {
      left = eight(load<uint64_t>(in_slot + d));
    } else {
      const uint64_t halves = load<uint32_t>(in_row + d / 2);
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
  int8_t* in_slot = needs_slot ? slots_[slot(row)] : nullptr;
  uint8_t* in_row = rest(row);
  counts_[row.value] = static_cast<uint8_t>(count);
  const auto n = static_cast<int16_t>(count);
  const size_t dim = dim_;
  std::array<int8_t, 256> means;
  rounded_means(sum.data(), count, (dim + 7) / 8 * 8, means.data());
  for (size_t d = 0; d < dim; d += 8) {
    const Eight left = load<Eight>(&sum[d]) - n * eight(load<uint64_t>(&means[d]));
    if (in_slot != nullptr) {
      store(in_slot + d, __builtin_convertvector(left, EightBytes));
    } else {
      const auto [low, high] = std::bit_cast<std::array<uint64_t, 2>>(left & 15);
      const uint64_t pairs = low | high << 4, bytes = (pairs | pairs >> 8) & 0xffff0000ffff;
      store(in_row + d / 2, static_cast<uint32_t>(bytes | bytes >> 16));
    }
  }
  uint32_t differences = 0;
  int8_t* at = packed() + packed_index(row.value, 0, dim);
  for (size_t d = 0; d < dim; d += 4, at += 4 * kPackedRows) {
    const auto after = load<uint32_t>(&means[d]);
    differences |= load<uint32_t>(at) ^ after;
    store(at, after);
  }
  if (uncommitted) uncommitted->insert(id(owner(row)));
  if (differences != 0 && quantizer_.nlist() != 0) to_reassign_.push_back(key(row));
}

void PrototypeStore::reassign(int threads) {
  for (size_t first = 0; first < to_reassign_.size(); first += kReassignChunk) {
    const size_t n = std::min(kReassignChunk, to_reassign_.size() - first);
    std::vector<Row> rows(n);
    find_rows({&to_reassign_[first], n}, rows);
    std::erase(rows, kNoRow);
    const auto lists = quantizer_.assign(rounded(rows), threads);
    std::vector<std::pair<Key, uint32_t>> moving;
    for (size_t i = 0; i < rows.size(); ++i) {
      if (lists_.list_of(rows[i]) != lists[i]) moving.emplace_back(key(rows[i]), lists[i]);
    }
    // By key, as the move of one row may change the index of another.
    for (const auto& [of_row, list] : moving) {
      const Row row = find_row(of_row.id, of_row.appearance);
      if (lists_.list_of(row) == list) continue;  // its key came twice
      relocate(row, take_row(list));
      close_gap(row);
    }
  }
  changes_ += to_reassign_.size();
  to_reassign_.clear();
}

CoarseQuantizer PrototypeStore::learn_quantizer(size_t nlist, int threads) const {
  std::vector<size_t> sample(std::min(prototype_count_, CoarseQuantizer::kSampleSize * nlist));
  for (size_t i = 0; i < sample.size(); ++i) sample[i] = i * prototype_count_ / sample.size();
  return CoarseQuantizer::learn(rounded(sorted_rows_at(sample)), nlist, threads);
}

PrototypeStore::Arrangement PrototypeStore::arrange(CoarseQuantizer quantizer, int threads) const {
  const size_t nlist = std::max<size_t>(quantizer.nlist(), 1);
  std::vector<Row> list_of_row(row_end(), kNoRow);
  std::vector<Row> rows;
  rows.reserve(std::min(prototype_count_, kAssignChunk));
  const auto assign = [&] {
    std::vector<uint32_t> lists(rows.size(), 0);
    if (quantizer.nlist() != 0) lists = quantizer.assign(rounded(rows), threads);
    for (size_t i = 0; i < rows.size(); ++i) list_of_row[rows[i].value].value = lists[i];
    rows.clear();
  };
  each_row([&](Row row) {
    rows.push_back(row);
    if (rows.size() == kAssignChunk) assign();
  });
  assign();
  ListOrder order(std::move(list_of_row), nlist);
  Arrangement result{std::move(quantizer), ListBlocks(nlist), std::move(order.new_rows)};
  result.lists.reserve(order.first_blocks.back());
  for (uint32_t list = 0; list < nlist; ++list) {
    for (uint32_t i = 0; i < order.sizes[list]; ++i) result.lists.append(list);
  }
  return result;
}

void PrototypeStore::rearrange(Arrangement arrangement) {
  const ListBlocks& lists = arrangement.lists;
  const size_t end = std::max(lists_.blocks(), lists.blocks()) * kPackedRows;
  for_each_array(0, end + kPackedRows, [](auto& v, size_t n, const auto&) { v.reserve(n); });
  relink(arrangement.to);
  resize(end + kPackedRows);
  permute(arrangement.to, row_at(end));
  for (uint32_t list = 0; list < lists.nlist(); ++list) {
    if (lists.rows(list) == 0) continue;
    for (Row row{lists.last(list).value + 1}; row.value % kPackedRows != 0; ++row.value)
      vacate(row);
  }
  quantizer_ = std::move(arrangement.quantizer);
  lists_ = std::move(arrangement.lists);
  resize(row_end());
  ++lists_version_;
  changes_ += prototype_count_;
  if (uncommitted) uncommitted->centroids = true;
}

// Moves every row to to[row], and uses up `to`. A row that is there moves on in its turn, until one
// comes to padding; `spare` and the next row hold rows meanwhile. In a large map nearly all of this
// waits for memory, which is therefore prefetched.
void PrototypeStore::permute(std::vector<Row>& to, Row spare) {
  constexpr int kMovesAhead = 8;
  // Where the row here goes; kNoRow if none has to leave.
  const auto next = [&](Row row) { return row.value < to.size() ? to[row.value] : kNoRow; };
  Row moving = spare, met{spare.value + 1};
  for (Row first{0}; first.value < to.size(); ++first.value) {
    if (to[first.value] == kNoRow || to[first.value] == first) continue;
    copy_row(first, moving);
    Row row = std::exchange(to[first.value], kNoRow), ahead = row;
    const auto prefetch_next = [&] {
      if (ahead == kNoRow) return;
      prefetch(ahead);
      RowTable::for_each_array(0, 1, [&](auto& v, size_t width, const auto&) {
        __builtin_prefetch(v.data() + ahead.value * width, 1);
      });
      ahead = next(ahead);
    };
    for (int i = 0; i < kMovesAhead; ++i) prefetch_next();
    while (next(row) != kNoRow) {
      prefetch_next();
      copy_row(row, met);
      copy_row(moving, row);
      std::swap(moving, met);
      row = std::exchange(to[row.value], kNoRow);
    }
    copy_row(moving, row);
  }
}

}  // namespace protomark
