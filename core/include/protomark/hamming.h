// Exact nearest neighbours of binary descriptors in Hamming distance.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "protomark/types.h"

namespace protomark {

struct HammingOptions {
  // The largest distance, in bits, at which a neighbour is reported.
  std::optional<std::int32_t> max_distance = std::nullopt;
  int threads = 1;
};

// Finds the k nearest rows of `database` for each query, nearest first, ties to the smaller row;
// ids are rows. Throws std::invalid_argument if shapes do not fit.
PROTOMARK_API Matches hamming_search(Descriptors queries, Descriptors database, std::size_t k = 2,
                                     const HammingOptions& options = {});

// Finds the k nearest landmarks: row i of `database` is a descriptor of landmarks[i], and a
// landmark is as far away as its nearest descriptor. Ids are landmark ids, ties to the smaller.
PROTOMARK_API Matches hamming_search(Descriptors queries, Descriptors database,
                                     std::span<const std::int64_t> landmarks, std::size_t k = 2,
                                     const HammingOptions& options = {});

}  // namespace protomark
