#include "base/quantize4.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <limits>

namespace protomark {

std::uint8_t quantize4(int value, int half_step) {
  // Levels are 2 half-steps apart, the lowest that is not negative is one half-step.
  const int above_zero = std::min(std::abs(value) / (2 * half_step), 7);
  return static_cast<std::uint8_t>(value < 0 ? 7 - above_zero : 8 + above_zero);
}

int best_half_step(const Occurrences& occurrences) {
  int best = 1;
  auto least = std::numeric_limits<std::uint64_t>::max();
  for (int half_step = 1; half_step <= kMaxScale; ++half_step) {
    std::uint64_t error = 0;
    for (std::size_t i = 0; i < occurrences.size(); ++i) {
      const int value = static_cast<int>(i) - 128;
      const int difference = value - level4(quantize4(value, half_step), half_step);
      error += static_cast<std::uint64_t>(difference * difference) * occurrences[i];
    }
    if (error < least) {
      least = error;
      best = half_step;
    }
  }
  return best;
}

}  // namespace protomark
