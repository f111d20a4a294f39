// int8 numbers in 4 bits: u, 0 to 15, stands for half_step * (2 u - 15).
#pragma once

#include <array>
#include <cstdint>

namespace protomark {

// The u whose level is nearest to `value`; of two the one away from zero, for zero the one above.
std::uint8_t quantize4(int value, int half_step);

constexpr int level4(std::uint8_t u, int half_step) { return half_step * (2 * u - 15); }

inline constexpr int kMaxScale = 8;  // 15 * 8 is the last multiple of 15 that int8 holds

// How often each int8 occurs, v at v + 128.
using Occurrences = std::array<std::uint64_t, 256>;

// The half-step, 1 to kMaxScale, with the least sum of squared errors over all values; of equals
// the smallest. For fewer than 2^49 values.
int best_half_step(const Occurrences& occurrences);

}  // namespace protomark
