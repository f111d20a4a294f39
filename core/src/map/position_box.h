// How far positions reach.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "protomark/prototypes.h"

namespace protomark {

struct PositionBox {
  Position low{};
  Position high{};
  std::size_t placed = 0;  // positions that are there; 0: low and high are zero

  // NaN is none.
  void add(const Position& p) {
    if (std::isnan(p[0])) return;
    for (std::size_t i = 0; i < 3; ++i) {
      low[i] = placed != 0 ? std::min(low[i], p[i]) : p[i];
      high[i] = placed != 0 ? std::max(high[i], p[i]) : p[i];
    }
    ++placed;
  }

  Position middle() const {
    return {low[0] / 2 + high[0] / 2, low[1] / 2 + high[1] / 2, low[2] / 2 + high[2] / 2};
  }
};

}  // namespace protomark
