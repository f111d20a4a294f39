// A map at a glance.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace protomark {

struct MapSummary {
  std::uint64_t observations = 0;  // a sealed map counts at most 255 of a landmark
  // Landmarks with as many observations as the index says, the last one: or more.
  std::array<std::uint64_t, 256> landmarks_by_count{};
  std::size_t placed = 0;  // landmarks with a position
  // The box around these; zeros where there are none.
  std::array<double, 3> low{};
  std::array<double, 3> high{};
};

}  // namespace protomark
