// Sorts a large set of indices piece by piece, in little memory.
#pragma once

#include <algorithm>
#include <cstddef>
#include <optional>
#include <span>
#include <vector>

namespace protomark {

// Calls visit(std::span<const Index>) for pieces of n indices (Row or LandmarkIndex) that together
// hold all of them by ascending key(index), which differs between them. `each(take)` calls
// take(index) for all indices. Takes 5 bits per index, and calls `each` about eight times.
template <typename Index, typename Each, typename Key, typename Visit>
void visit_sorted(size_t n, const Each& each, const Key& key, const Visit& visit) {
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
    visit(std::span<const Index>(indices));
  }
}

}  // namespace protomark
