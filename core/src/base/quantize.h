// Sums of codes; their means rounded to int8, and numbers to 4 bits.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdlib>

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

// Scalar quantization to 4 bits: u, 0 to 15, means the level scale * (2 u - 15).
inline constexpr int kMaxScale = 8;  // 15 * 8 is the last multiple of 15 that int8 holds

// Returns the u whose level is nearest to `value`, ties away from zero and for zero upwards.
inline uint8_t sq4_quantize(int value, int scale) {
  // Levels are 2 * scale apart; the lowest that is not negative is `scale`.
  const int above_zero = std::min(std::abs(value) / (2 * scale), 7);
  return static_cast<uint8_t>(value < 0 ? 7 - above_zero : 8 + above_zero);
}

constexpr int sq4_level(int u, int scale) { return scale * (2 * u - 15); }

// Counts each int8 value v at index v + 128.
using Histogram = std::array<uint64_t, 256>;

// Returns the scale, 1 to kMaxScale, of least squared error over fewer than 2^49 values, ties to
// the smaller.
inline int sq4_best_scale(const Histogram& histogram) {
  const auto error = [&](int scale) {
    uint64_t sum = 0;
    for (size_t i = 0; i < histogram.size(); ++i) {
      const int value = static_cast<int>(i) - 128;
      const int difference = value - sq4_level(sq4_quantize(value, scale), scale);
      sum += static_cast<uint64_t>(difference * difference) * histogram[i];
    }
    return sum;
  };
  int best = 1;
  for (int scale = 2; scale <= kMaxScale; ++scale) {
    if (error(scale) < error(best)) best = scale;
  }
  return best;
}

}  // namespace protomark
