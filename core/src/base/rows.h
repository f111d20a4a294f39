// Row and LandmarkIndex, two kinds of 32-bit index that the compiler keeps apart, and how many of
// them are sorted in little memory.
#pragma once

#include <algorithm>
#include <functional>

#include "protomark/types.h"

namespace protomark {

// The index of a prototype among the packed prototypes of a map.
struct Row {
  uint32_t value = 0;
  friend constexpr auto operator<=>(Row, Row) = default;
};

// The index of a landmark in a map; its id is the user's.
struct LandmarkIndex {
  uint32_t value = 0;
  friend constexpr auto operator<=>(LandmarkIndex, LandmarkIndex) = default;
};

constexpr Row row_at(size_t i) { return {static_cast<uint32_t>(i)}; }
constexpr LandmarkIndex landmark_at(size_t i) { return {static_cast<uint32_t>(i)}; }

inline constexpr Row kNoRow{UINT32_MAX};
inline constexpr LandmarkIndex kNoLandmark{UINT32_MAX};

template <typename T>
void sort_unique(std::vector<T>& values) {
  if (!std::is_sorted(values.begin(), values.end())) std::sort(values.begin(), values.end());
  values.erase(std::unique(values.begin(), values.end()), values.end());
}

template <typename Index>
using VisitPiece = std::function<void(std::span<const Index>)>;

// Calls visit for pieces of n indices (Row or LandmarkIndex), which together hold all of them by
// ascending key(index), which differs between them. `each(take)` calls take(index) for all indices.
// Takes 5 bits per index, and calls `each` about eight times.
template <typename Index, typename Each, typename Key>
void visit_sorted(size_t n, const Each& each, const Key& key, const VisitPiece<Index>& visit) {
  constexpr size_t kPieces = 8, kMinPiece = 1 << 13;
  const auto less = [&](Index a, Index b) { return key(a) < key(b); };
  const size_t piece = std::max(kMinPiece, (n + kPieces - 1) / kPieces);
  const size_t limit = piece + piece / 4;
  std::vector<Index> indices;
  indices.reserve(std::min(n, limit));
  for (size_t seen = 0; seen < n; seen += indices.size()) {
    // Takes the least keys above the last one of the piece before, which are below `end` once there
    // were too many.
    std::optional<decltype(key(Index{}))> last, end;
    if (seen > 0) last = key(indices.back());
    indices.clear();
    each([&](Index index) {
      const auto value = key(index);
      if ((last && !(*last < value)) || (end && *end < value)) return;
      indices.push_back(index);
      if (indices.size() < limit || limit >= n) return;
      const auto middle = indices.begin() + static_cast<std::ptrdiff_t>(piece - 1);
      std::nth_element(indices.begin(), middle, indices.end(), less);
      end = key(*middle);
      indices.resize(piece);
    });
    std::sort(indices.begin(), indices.end(), less);
    visit(indices);
  }
}

}  // namespace protomark
