// Which appearances of a landmark are best merged: Ward's criterion.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace protomark {

// Merges prototype `source` into prototype `into`, which stands before it and keeps its index.
struct AppearanceMerge {
  double cost;
  std::uint16_t into;
  std::uint16_t source;
};

// Returns all merges that make one prototype of several, at each step the one of least cost, of
// equals that of the first rows. `sums` is (rows x dim), `counts` (rows), at most 65536 rows. Of
// more than 2048 rows neighbours are first merged, at no cost, until there are as many.
//
// The cost of merging the means a and b of n and m observations is what that adds to the sum of
// squared distances of all observations to their means (Ward 1963), |a - b|^2 n m / (n + m). It is
// computed from the integer sums in a fixed order of operations, so that it is the same double on
// every machine.
std::vector<AppearanceMerge> appearance_merges(std::span<const std::int16_t> sums,
                                               std::span<const std::uint8_t> counts,
                                               std::size_t dim);

}  // namespace protomark
