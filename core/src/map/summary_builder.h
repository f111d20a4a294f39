#pragma once

#include <algorithm>
#include <cstdint>

#include "map/position_box.h"
#include "protomark/map_summary.h"

namespace protomark {

class SummaryBuilder {
 public:
  // A landmark; NaN: it has no position.
  void add(std::uint32_t observations, const Position& position) {
    summary_.observations += observations;
    ++summary_.landmarks_by_count[std::min(observations, 255u)];
    box_.add(position);
  }

  MapSummary take() {
    summary_.placed = box_.placed;
    summary_.low = box_.low;
    summary_.high = box_.high;
    return summary_;
  }

 private:
  MapSummary summary_;
  PositionBox box_;
};

}  // namespace protomark
