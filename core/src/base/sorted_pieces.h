// Sorts a large set of indices piece by piece, in little memory.
#pragma once

#include <algorithm>
#include <cstddef>
#include <span>
#include <vector>

namespace protomark {

// Calls visit(std::span<const Index>) for pieces of n indices (Row or LandmarkIndex) that together
// hold all of them by ascending key(index), which differs between them. `each(take)` calls
// take(index) for all indices. Takes 5 bits per index, and calls `each` about ten times.
template <typename Index, typename Each, typename Key, typename Visit>
void visit_sorted(std::size_t n, const Each& each, const Key& key, const Visit& visit) {
  using Value = decltype(key(Index{}));
  constexpr std::size_t kPieces = 8, kMinPiece = 1 << 13, kSample = 1 << 10;
  const auto less = [&](Index a, Index b) { return key(a) < key(b); };
  const std::size_t piece = std::max(kMinPiece, (n + kPieces - 1) / kPieces);
  const std::size_t limit = piece + piece / 4;
  std::vector<Index> indices;
  indices.reserve(std::min(n, limit));

  std::vector<Value> bounds;  // keys about a piece apart, by a sample
  bool sorted = true;
  if (n > limit) {
    Value before{};
    std::size_t i = 0;
    each([&](Index index) {
      const Value value = key(index);
      sorted = sorted && (i == 0 || before < value);
      before = value;
      if (i++ % ((n + kSample - 1) / kSample) == 0) bounds.push_back(value);
    });
    std::sort(bounds.begin(), bounds.end());
    const std::size_t step = std::max<std::size_t>(1, bounds.size() * piece / n);
    for (i = 0; (i + 1) * step < bounds.size(); ++i) bounds[i] = bounds[(i + 1) * step];
    bounds.resize(i);
  }
  if (n > limit && sorted) {
    each([&](Index index) {
      indices.push_back(index);
      if (indices.size() < piece) return;
      visit(std::span<const Index>(indices));
      indices.clear();
    });
    if (!indices.empty()) visit(std::span<const Index>(indices));
    return;
  }

  // A piece holds the keys above `last`, that of the piece before, up to `end`, where there are
  // such.
  Value last{}, end{};
  bool bounded = false;
  auto bound = bounds.begin();
  for (std::size_t seen = 0; seen < n; seen += indices.size(), last = key(indices.back())) {
    const bool first = seen == 0;
    while (bound != bounds.end() && !first && !(last < *bound)) ++bound;
    bounded = bound != bounds.end();
    if (bounded) end = *bound;
    indices.clear();
    each([&](Index index) {
      const Value value = key(index);
      if ((bounded && end < value) || (!first && !(last < value))) return;
      if (indices.size() == limit) {  // the sample promised fewer
        const auto middle = indices.begin() + static_cast<std::ptrdiff_t>(piece - 1);
        std::nth_element(indices.begin(), middle, indices.end(), less);
        bounded = true;
        end = key(*middle);
        indices.resize(piece);
        if (end < value) return;
      }
      indices.push_back(index);
    });
    std::sort(indices.begin(), indices.end(), less);
    visit(std::span<const Index>(indices));
  }
}

}  // namespace protomark
