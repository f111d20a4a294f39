#include "base/sq4.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <limits>

namespace protomark {

std::uint8_t sq4_quantize(int value, int scale) {
  // Levels are 2 * scale apart; the lowest that is not negative is `scale`.
  const int above_zero = std::min(std::abs(value) / (2 * scale), 7);
  return static_cast<std::uint8_t>(value < 0 ? 7 - above_zero : 8 + above_zero);
}

int sq4_best_scale(const Histogram& histogram) {
  int best = 1;
  auto least = std::numeric_limits<std::uint64_t>::max();
  for (int scale = 1; scale <= kMaxScale; ++scale) {
    std::uint64_t error = 0;
    for (std::size_t i = 0; i < histogram.size(); ++i) {
      const int value = static_cast<int>(i) - 128;
      const int difference = value - sq4_level(sq4_quantize(value, scale), scale);
      error += static_cast<std::uint64_t>(difference * difference) * histogram[i];
    }
    if (error < least) {
      least = error;
      best = scale;
    }
  }
  return best;
}

}  // namespace protomark
