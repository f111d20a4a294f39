// Positions in 16 bits a coordinate.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

#include "map/position_box.h"
#include "protomark/prototypes.h"

namespace protomark {

// A grid over the box of all positions, each axis with a step of its own: on the longest axis that
// is the step that one for all axes would be, and on the others less, as where a map is flat.
struct PositionGrid {
  using Cell = std::array<std::uint16_t, 3>;
  static constexpr std::uint16_t kLast = 65534;
  static constexpr std::uint16_t kNowhere = 65535;  // on all axes

  Position origin{};
  Position step{};

  PositionGrid() = default;
  PositionGrid(const Position& from, const Position& steps) : origin(from), step(steps) {}
  explicit PositionGrid(const PositionBox& box) : origin(box.low) {
    for (std::size_t i = 0; i < 3; ++i) step[i] = (box.high[i] - box.low[i]) / kLast;
  }

  Cell cell(const Position& p) const {
    Cell result;
    result.fill(kNowhere);
    for (std::size_t i = 0; i < 3 && !std::isnan(p[0]); ++i) {
      const double steps = step[i] > 0 ? std::round((p[i] - origin[i]) / step[i]) : 0;
      result[i] = static_cast<std::uint16_t>(std::clamp(steps, 0.0, double{kLast}));
    }
    return result;
  }

  Position position(const Cell& cell) const {
    Position result;
    for (std::size_t i = 0; i < 3; ++i) result[i] = origin[i] + step[i] * cell[i];
    constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
    const bool nowhere = std::find(cell.begin(), cell.end(), kNowhere) != cell.end();
    return nowhere ? Position{kNaN, kNaN, kNaN} : result;
  }
};

}  // namespace protomark
