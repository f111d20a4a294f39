// Adds observations to a learning map.
#include <algorithm>
#include <array>
#include <cstring>

#include "base/rounded_mean.h"
#include "map/prototype_store.h"
#include "protomark/prototype_map.h"

namespace protomark {
namespace {

// In a large map nearly all time goes into waiting for memory, which is prefetched so many
// observations ahead.
constexpr std::size_t kAhead = 16;

// Halves a sum of which `count` observations are left. A mean of 127 stays one, although half of an
// odd count is rounded down.
std::int16_t half(int sum, int count) {
  return static_cast<std::int16_t>(std::clamp(sum / 2, -127 * count, 127 * count));
}

}  // namespace

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
  for (std::size_t i = 0; i < n + kAhead; ++i) {
    if (i < n && rows[i] != kNoRow) prefetch_prototype(rows[i]);
    if (i < kAhead) continue;
    const std::size_t at = i - kAhead;
    const Row row = rows[at];
    if (row == kNoRow) continue;
    add(row, codes.row(at));
    // Once is enough if the next observation is of the same row.
    if (at + 1 == n || rows[at + 1] != row) refresh(row);
  }
  // If memory runs out, what was added so far stays, and answers.
  for (std::size_t i = 0; i < n; ++i) {
    if (rows[i] != kNoRow) continue;
    const std::uint16_t appearance = appearance_of(codes.row(i));
    const Row row = find_or_create_row(ids[i], appearance);
    add(row, codes.row(i));
    const bool again =
        i + 1 < n && ids[i + 1] == ids[i] && appearance_of(codes.row(i + 1)) == appearance;
    if (!again) refresh(row);
  }
}

void PrototypeStore::add(Row row, const std::int8_t* code) {
  std::int16_t* s = sum(row);
  std::uint8_t& n = counts_[row.value];
  if (n == PrototypeMap::kMaxCount) {
    n /= 2;
    for (std::size_t d = 0; d < dim_; ++d) s[d] = half(s[d], n);
  }
  // A caller may write over codes that were checked: even then no sum is impossible.
  for (std::size_t d = 0; d < dim_; ++d) {
    s[d] = static_cast<std::int16_t>(s[d] + std::max<std::int16_t>(code[d], -127));
  }
  ++n;
}

void PrototypeStore::merge(Row row, const std::int16_t* other, int other_count) {
  const int n = count(row) + other_count;
  const bool halved = n > PrototypeMap::kMaxCount;  // once is enough for 255 + 255
  set_count(row, halved ? n / 2 : n);
  std::int16_t* s = sum(row);
  for (std::size_t d = 0; d < dim_; ++d) {
    const int total = s[d] + other[d];
    s[d] = halved ? half(total, count(row)) : static_cast<std::int16_t>(total);
  }
  refresh(row);
}

void PrototypeStore::refresh(Row row) {
  std::array<std::int8_t, 256> means;
  rounded_means(sum(row), count(row), dim_, means.data());
  std::fill(means.begin() + dim_, means.begin() + packed_dim(dim_), std::int8_t{0});
  std::uint32_t differences = 0;
  for (std::size_t d = 0; d < dim_; d += 4) {
    std::int8_t* at = packed() + packed_index(row.value, d, dim_);
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

}  // namespace protomark
