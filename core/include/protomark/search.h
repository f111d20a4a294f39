// What a search in a map may be asked for.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>

namespace protomark {

// A search finds the k nearest landmarks of each query code, nearest first, ties to the smaller id.
// A landmark is as far away as the nearest of its prototypes.
//
// Distances are squared Euclidean distances in code units, which are integers. Where there is no
// neighbour the id is -1 and the distance INT32_MAX.
struct SearchOptions {
  // Approximate search in a map with an index: searches as many of the inverted lists nearest to
  // the query as bring this recall, above 0 and at most 1; or `nprobe` lists, at least 1. At most
  // one of these may be set. If neither is, the search is exact.
  std::optional<double> recall = std::nullopt;
  std::optional<std::size_t> nprobe = std::nullopt;
  // The largest squared distance at which a neighbour is reported.
  std::optional<std::int32_t> max_distance = std::nullopt;
  // Lowe's ratio test, of root distances: a query keeps its neighbours only if its nearest landmark
  // is nearer than `ratio` times the second nearest, or if there is no second. In (0, 1]. The test
  // is `nearest < ratio * ratio * second` of squared distances, computed in doubles from left to
  // right.
  std::optional<double> ratio = std::nullopt;
  int threads = 1;
};

}  // namespace protomark
