// Observations are added to an open map.
#include <algorithm>
#include <array>
#include <cstring>
#include <mutex>
#include <vector>

#include "base/rounded_mean.h"
#include "map/prototype_store.h"

namespace protomark {
namespace {

// In a large map nearly everything here waits for memory, which is asked for so many observations
// ahead.
constexpr std::size_t kAhead = 16;

// Half of a sum, of which `count` observations are left: a mean of 127 stays one, although half of
// an odd count is rounded down.
std::int16_t half(int sum, int count) {
  return static_cast<std::int16_t>(std::clamp(sum / 2, -127 * count, 127 * count));
}

}  // namespace

void PrototypeStore::find_rows(std::span<const std::int64_t> landmarks, Codes codes,
                               std::span<std::uint32_t> rows) const {
  const std::size_t n = rows.size();
  for (std::size_t i = 0; i < n + 2 * kAhead; ++i) {
    if (i < n) index_.prefetch_slot(landmarks[i]);
    if (i >= kAhead && i < n + kAhead) index_.prefetch_ids(ids_, landmarks[i - kAhead]);
    if (i < 2 * kAhead) continue;
    const std::size_t at = i - 2 * kAhead;
    const std::uint32_t landmark = find(landmarks[at]);
    rows[at] = landmark == kNone || look_bits_ == 0 ? landmark
                                                    : find_row(landmark, look_of(codes.row(at)));
  }
}

void PrototypeStore::add(std::span<const std::int64_t> landmarks, Codes codes,
                         std::span<const std::uint32_t> rows) {
  const std::size_t n = rows.size();
  if (cells_.nlist() != 0) unsettled_.reserve(unsettled_.size() + n);
  for (std::size_t i = 0; i < n + kAhead; ++i) {
    if (i < n && rows[i] != kNone) prefetch_prototype(rows[i]);
    if (i < kAhead) continue;
    const std::size_t at = i - kAhead;
    const std::uint32_t row = rows[at];
    if (row == kNone) continue;
    add(row, codes.row(at));
    // One turn is enough where the next observation is of the same row.
    if (at + 1 == n || rows[at + 1] != row) refresh(row);
  }
  // Where memory runs out, what was added so far stays, and answers.
  for (std::size_t i = 0; i < n; ++i) {
    if (rows[i] != kNone) continue;
    const std::uint16_t look = look_of(codes.row(i));
    const std::uint32_t row = find_or_create_row(landmarks[i], look);
    add(row, codes.row(i));
    const bool again =
        i + 1 < n && landmarks[i + 1] == landmarks[i] && look_of(codes.row(i + 1)) == look;
    if (!again) refresh(row);
  }
}

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
  std::array<std::int8_t, 256> means;
  rounded_means(sum(row), counts_[row], dim_, means.data());
  std::fill(means.begin() + dim_, means.begin() + packed_dim(dim_), std::int8_t{0});
  std::uint32_t differences = 0;
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::int8_t* place = packed() + packed_index(row, d, dim_);
    std::uint32_t before, after;
    std::memcpy(&before, place, 4);
    std::memcpy(&after, &means[d], 4);
    std::memcpy(place, &after, 4);
    differences |= before ^ after;
  }
  if (uncommitted_) uncommitted_->insert(ids_[landmark_of(row)]);
  if (differences != 0 && cells_.nlist() != 0) {
    unsettled_.push_back({ids_[landmark_of(row)], look(row)});
  }
}

void PrototypeMap::Store::add_in_pieces(std::span<const std::int64_t> landmarks, Codes codes,
                                        int threads) {
  std::vector<std::uint32_t> found(std::min(codes.rows, kPiece));
  for (std::size_t begin = 0; begin < codes.rows; begin += kPiece) {
    const std::size_t n = std::min(kPiece, codes.rows - begin);
    const auto ids = landmarks.subspan(begin, n);
    const Codes piece{codes.row(begin), n, codes.columns};
    const auto rows = std::span(found).first(n);
    find_rows(ids, piece, rows);
    std::size_t new_landmarks = 0, new_rows = 0;
    for (std::size_t i = 0; i < n; ++i) {
      if (rows[i] != kNone) continue;
      ++new_rows;
      if (find(ids[i]) == kNone) ++new_landmarks;
    }
    make_room(new_landmarks, new_rows, n);
    const std::unique_lock lock(mutex);
    add(ids, piece, rows);
    settle(threads);
  }
}

}  // namespace protomark
