// Ward's criterion: which prototypes of a landmark are best joined.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace protomark {

// Prototype `from` goes into prototype `into`, which stands before it and keeps its place.
struct Join {
  double cost;
  std::uint16_t into;
  std::uint16_t from;
};

// All joins that make one prototype of several, the cheapest at each step first, of equals the one
// of the first rows. `sums` is (rows x dim), `counts` (rows), at most 65536 rows.
//
// Of more than 2048 rows, neighbours are joined first, at no cost, until there are as many.
//
// What a join of the means a and b of n and m observations costs is the growth of the sum of
// squared distances to the mean (Ward 1963), |a - b|^2 n m / (n + m). It is computed from the
// integer sums in a fixed order of operations, so that it is the same double on every machine.
std::vector<Join> ward_joins(std::span<const std::int16_t> sums,
                             std::span<const std::uint8_t> counts, std::size_t dim);

}  // namespace protomark
