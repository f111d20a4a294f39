// The cells of which a query's neighbours may be.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "protomark/search.h"

namespace protomark {

// (queries x probes) numbers of the centroids that are nearest to each query, ties to the smaller,
// the nearest first, the others in no order. `probes` is 1 to the number of centroids. TopK is for
// a few neighbours, here they may be hundreds.
std::vector<std::uint32_t> nearest_cells(const PackedPrototypes& centroids, Codes queries,
                                         std::size_t probes, int threads);

}  // namespace protomark
