// Options of a search in a map.
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
  // Make the search in a map with an index approximate: it visits the inverted lists nearest to the
  // query, as many as this recall takes, above 0 and at most 1, or `nprobe` of them, at least 1. At
  // most one of the two may be set. If neither is, the search is exact.
  std::optional<double> recall = std::nullopt;
  std::optional<std::size_t> nprobe = std::nullopt;
  // The largest squared distance at which a neighbour is reported.
  std::optional<std::int32_t> max_distance = std::nullopt;
  // Lowe's ratio test, in (0, 1]: a query keeps its neighbours only if there is one landmark, or if
  // the squared distances fulfil nearest < ratio * ratio * second, in doubles from left to right.
  std::optional<double> ratio = std::nullopt;
  int threads = 1;
};

}  // namespace protomark
