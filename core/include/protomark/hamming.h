// Exact nearest neighbours of binary descriptors in Hamming distance.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "protomark/matrix_view.h"

namespace protomark {

struct HammingOptions {
  // The largest distance, in bits, at which a neighbour is reported.
  std::optional<std::int32_t> max_distance;
  int threads = 1;
};

// Finds the k nearest rows of `database` for each query, nearest first, ties to the smaller row.
//
// ids and distances are (queries x k), k = ids.columns. Where there is no neighbour the id is -1
// and the distance INT32_MAX. Throws std::invalid_argument if shapes do not fit.
void hamming_search(Descriptors queries, Descriptors database, const HammingOptions& options,
                    MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances);

// Finds the k nearest *landmarks*: row i of `database` is a descriptor of landmarks[i], a landmark
// is as far away as its nearest descriptor, and ids are landmark ids, ties to the smaller.
void hamming_search(Descriptors queries, Descriptors database,
                    std::span<const std::int64_t> landmarks, const HammingOptions& options,
                    MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances);

}  // namespace protomark
