// Scalar quantization to 4 bits: u, 0 to 15, stands for the level scale * (2 u - 15).
#pragma once

#include <array>
#include <cstdint>

namespace protomark {

inline constexpr int kMaxScale = 8;  // 15 * 8 is the last multiple of 15 that int8 holds

// The u whose level is nearest to `value`; of two the one away from zero, for zero the one above.
std::uint8_t sq4_quantize(int value, int scale);

constexpr int sq4_level(std::uint8_t u, int scale) { return scale * (2 * u - 15); }

// How often each int8 value v occurs, at v + 128.
using Histogram = std::array<std::uint64_t, 256>;

// The scale, 1 to kMaxScale, with the least sum of squared errors over all values; of equals the
// smallest. For fewer than 2^49 values.
int sq4_best_scale(const Histogram& histogram);

}  // namespace protomark
