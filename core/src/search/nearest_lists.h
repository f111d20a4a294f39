// The inverted lists that a query looks into.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "search/code_scan.h"
#include "search/packed.h"

namespace protomark {

// Returns (queries x nprobe) indices of the centroids that are nearest to each query, ties to the
// smaller, the nearest first, the others in no order. `nprobe` is 1 to the number of centroids.
// TopK is for a few neighbours, here they may be hundreds.
std::vector<std::uint32_t> nearest_lists(const PackedPrototypes& centroids,
                                         const PreparedCodes& queries, std::size_t nprobe,
                                         int threads);

}  // namespace protomark
