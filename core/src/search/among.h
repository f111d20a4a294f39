// Search among some landmarks of a map.
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <vector>

#include "search/inverted_lists.h"

namespace protomark {

// The landmarks to search.
struct Selection {
  std::vector<LandmarkIndex> landmarks;  // ascending, each once
  std::size_t landmark_end = 0;          // all landmarks of the map are below
  // Appends the rows of a landmark.
  std::function<void(LandmarkIndex, std::vector<Row>&)> append_rows;
};

// Sorts landmarks and drops those that occur again.
void sort_unique(std::vector<LandmarkIndex>& landmarks);

// Searches as search_lists does, but only the rows of some landmarks. They are packed anew, a piece
// at a time, and searched as a small map, at a cost that follows their number; or, where that is
// less work, all rows are compared and those of other landmarks are passed over. With
// options.recall more lists are searched than `nprobe`, as many as hold so many of these rows.
Matches search_among(const Selection& selection, PackedPrototypes prototypes,
                     const InvertedLists& lists, const PackedPrototypes& centroids,
                     std::size_t nprobe, Codes queries, std::size_t k,
                     const SearchOptions& options);

}  // namespace protomark
