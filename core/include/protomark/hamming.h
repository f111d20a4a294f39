// Exact nearest neighbours of binary descriptors in Hamming distance.
#pragma once

#include "protomark/types.h"

namespace protomark {

struct HammingOptions {
  // The landmark of each row of the database. With it, a search finds the k nearest landmarks, each
  // as far away as its nearest descriptor, and ids are landmark ids.
  std::optional<std::span<const int64_t>> landmarks = std::nullopt;
  // The largest distance, in bits, at which a neighbour is reported.
  std::optional<int32_t> max_distance = std::nullopt;
  int threads = 1;
};

// Finds the k nearest rows of `database` for each query, nearest first, ties to the smaller id; ids
// are rows unless there are landmarks. Throws std::invalid_argument if shapes do not fit.
PROTOMARK_API Matches hamming_search(Descriptors queries, Descriptors database, size_t k = 2,
                                     const HammingOptions& options = {});

}  // namespace protomark
