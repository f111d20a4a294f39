// Options of a search in a map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

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
  std::optional<size_t> nprobe = std::nullopt;
  // The largest squared distance at which a neighbour is reported.
  std::optional<int32_t> max_distance = std::nullopt;
  // Lowe's ratio test, in (0, 1]: a query keeps its neighbours only if there is one landmark, or if
  // the squared distances fulfil nearest < ratio * ratio * second, in doubles from left to right.
  std::optional<double> ratio = std::nullopt;
  // Searches only these landmarks, as a map that held no others would answer; empty: none. In an
  // approximate search `recall` is then the aim, not a measured share: as many lists are searched
  // as hold as many of these landmarks as `nprobe` lists hold of all, or all of them if that is
  // less work. std::out_of_range names an id that is not in the map.
  std::optional<std::span<const int64_t>> among = std::nullopt;
  int threads = 1;
};

}  // namespace protomark
