#include "base/quantize.h"

#include <cstdlib>

#include "check.h"

using namespace protomark;

namespace {

Histogram once(std::initializer_list<int> values) {
  Histogram result{};
  for (const int value : values) ++result[static_cast<std::size_t>(value + 128)];
  return result;
}

}  // namespace

int main() {
  for (int scale = 1; scale <= kMaxScale; ++scale) {
    for (int value = -128; value < 128; ++value) {
      const std::uint8_t u = sq4_quantize(value, scale);
      CHECK(u < 16);
      const int error = std::abs(value - sq4_level(u, scale));
      for (std::uint8_t other = 0; other < 16; ++other) {
        const int level = sq4_level(other, scale);
        CHECK(error <= std::abs(value - level));
        // Halves round away from zero.
        if (error == std::abs(value - level) && value != 0) {
          CHECK(std::abs(level) <= std::abs(sq4_level(u, scale)));
        }
      }
    }
    CHECK(sq4_quantize(0, scale) == 8);
  }

  CHECK(sq4_best_scale({}) == 1);
  CHECK(sq4_best_scale(once({127, -127})) == 8);
  CHECK(sq4_best_scale(once({-15, -9, 3, 15})) == 1);
  CHECK(sq4_best_scale(once({-75, 5, 65})) == 5);
  // 21 is a level of 3 and of 7.
  CHECK(sq4_best_scale(once({21})) == 3);
  Histogram many{};
  many[0] = std::uint64_t{1} << 48;
  many[128 + 1] = 1;
  CHECK(sq4_best_scale(many) == 8);
  return check::result();
}
