// Row and LandmarkIndex, two kinds of 32-bit index that the compiler keeps apart.
#pragma once

#include <algorithm>

#include "protomark/types.h"

namespace protomark {

// The index of a prototype among the packed prototypes of a map.
struct Row {
  uint32_t value = 0;
  friend constexpr auto operator<=>(Row, Row) = default;
};

// The index of a landmark in a map; its id is the user's.
struct LandmarkIndex {
  uint32_t value = 0;
  friend constexpr auto operator<=>(LandmarkIndex, LandmarkIndex) = default;
};

constexpr Row row_at(size_t i) { return {static_cast<uint32_t>(i)}; }
constexpr LandmarkIndex landmark_at(size_t i) { return {static_cast<uint32_t>(i)}; }

inline constexpr Row kNoRow{UINT32_MAX};
inline constexpr LandmarkIndex kNoLandmark{UINT32_MAX};

template <typename T>
void sort_unique(std::vector<T>& values) {
  if (!std::is_sorted(values.begin(), values.end())) std::sort(values.begin(), values.end());
  values.erase(std::unique(values.begin(), values.end()), values.end());
}

}  // namespace protomark
