// Sums of codes, and their means rounded to int8.
#pragma once

#include <cstdlib>

#include "protomark/types.h"

namespace protomark {

// The sum of codes of at most 256 numbers. Zeros follow the last one up to a multiple of 8.
using Sum = std::array<int16_t, 256>;

inline int32_t squared_distance(const int8_t* a, const int8_t* b, size_t dim) {
  int32_t sum = 0;
  for (size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
  return sum;
}

// Returns sum / n rounded to the nearest integer, halves away from zero.
template <typename Integer>
int8_t rounded_mean(Integer sum, Integer n) {
  const Integer magnitude = (2 * std::abs(sum) + n) / (2 * n);
  return static_cast<int8_t>(sum < 0 ? -magnitude : magnitude);
}

// Computes the same for `dim` sums, without divisions; n is 1 to 255 and no sum beyond 127 n. With
// 1/2 added, no quotient is nearer to an integer than its own error, 2^-23 of itself.
inline void rounded_means(const int16_t* sums, int n, size_t dim, int8_t* means) {
  const float reciprocal = 1.0f / static_cast<float>(2 * n);
  for (size_t d = 0; d < dim; ++d) {
    const int sum = sums[d];
    const auto twice = static_cast<float>(2 * (sum < 0 ? -sum : sum) + n);
    const auto magnitude = static_cast<int>((twice + 0.5f) * reciprocal);
    means[d] = static_cast<int8_t>(sum < 0 ? -magnitude : magnitude);
  }
}

}  // namespace protomark
