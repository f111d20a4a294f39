// Search among all or some landmarks of a map.
#pragma once

#include "search/inverted_lists.h"

namespace protomark {

// The landmarks of a map.
struct LandmarkRows {
  size_t end;  // all indices are below
  std::function<LandmarkIndex(int64_t id)> at;
  // Appends the rows of a landmark.
  std::function<void(LandmarkIndex, std::vector<Row>&)> append;
};

// Searches as search_lists does, but with options.among only the rows of these landmarks. They are
// packed anew, a piece at a time, and searched as a small map, at a cost that follows their number;
// or, where that is less work, all rows are compared and those of other landmarks are passed over.
// With options.recall more lists are then searched than `nprobe`, as many as hold so many of these
// rows.
Matches search_map(PackedPrototypes prototypes, const InvertedLists& lists,
                   const PackedPrototypes& centroids, const LandmarkRows& landmarks, size_t nprobe,
                   Codes queries, size_t k, const SearchOptions& options);

}  // namespace protomark
