#include "base/quantize4.h"

#include <cstdlib>

#include "check.h"
#include "protomark/search.h"

using namespace protomark;

namespace {

Occurrences once(std::initializer_list<int> values) {
  Occurrences result{};
  for (const int value : values) ++result[static_cast<std::size_t>(value + 128)];
  return result;
}

}  // namespace

int main() {
  for (int half_step = 1; half_step <= kMaxScale; ++half_step) {
    for (int value = -128; value < 128; ++value) {
      const std::uint8_t u = quantize4(value, half_step);
      CHECK(u < 16);
      const int error = std::abs(value - level4(u, half_step));
      for (std::uint8_t other = 0; other < 16; ++other) {
        const int level = level4(other, half_step);
        CHECK(error <= std::abs(value - level));
        // Halves go away from zero.
        if (error == std::abs(value - level) && value != 0) {
          CHECK(std::abs(level) <= std::abs(level4(u, half_step)));
        }
      }
    }
    CHECK(quantize4(0, half_step) == 8);
  }

  CHECK(best_half_step({}) == 1);
  CHECK(best_half_step(once({127, -127})) == 8);
  CHECK(best_half_step(once({-15, -9, 3, 15})) == 1);
  CHECK(best_half_step(once({-75, 5, 65})) == 5);
  // 21 is a level of 3 and of 7.
  CHECK(best_half_step(once({21})) == 3);
  Occurrences many{};
  many[0] = std::uint64_t{1} << 48;
  many[128 + 1] = 1;
  CHECK(best_half_step(many) == 8);
  return check::result();
}
