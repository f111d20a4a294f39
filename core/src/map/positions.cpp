#include "map/positions.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "file/sections.h"

namespace protomark {

void add_to_summary(MapSummary& summary, std::uint32_t observations, const Position& position) {
  summary.observations += observations;
  ++summary.count_histogram[std::min(observations, 255u)];
  if (std::isnan(position[0])) return;
  ++summary.landmarks_with_position;
  if (!summary.extent) summary.extent = {position, position};
  auto& [low, high] = *summary.extent;
  for (std::size_t i = 0; i < 3; ++i) {
    low[i] = std::min(low[i], position[i]);
    high[i] = std::max(high[i], position[i]);
  }
}

PositionCodec::PositionCodec(const std::array<Position, 2>& extent, int bits) : bits_(bits) {
  for (std::size_t i = 0; i < 3; ++i) {
    const double low = extent[0][i], high = extent[1][i], middle = low / 2 + high / 2;
    if (std::max(high - middle, middle - low) > std::numeric_limits<float>::max()) {
      invalid("positions are too far apart for a sealed map");
    }
    origin_[i] = bits == 16 ? low : middle;
    if (bits == 16) step_[i] = (high - low) / kLast;
  }
}

PositionCodec::PositionCodec(const ContainerReader& file, const Position& origin)
    : origin_(origin) {
  if (!file.has(section::kSteps)) return;
  bits_ = 16;
  step_ = read_value<Position>(file, section::kSteps);
  for (std::size_t i = 0; i < 3; ++i) {
    if (!(step_[i] >= 0) || !std::isfinite(origin_[i] + step_[i] * kLast)) {
      file.fail("the steps of its positions are impossible");
    }
  }
}

void PositionCodec::encode(const Position& p, std::byte* to) const {
  for (std::size_t i = 0; i < 3; ++i) {
    const double distance = p[i] - origin_[i];
    if (bits_ == 32) {
      const auto number = static_cast<float>(distance);
      std::memcpy(to + i * sizeof(number), &number, sizeof(number));
    } else {
      const double steps = step_[i] > 0 ? std::round(distance / step_[i]) : 0;
      const auto number = std::isnan(p[0])
                              ? kNone
                              : static_cast<std::uint16_t>(std::clamp(steps, 0.0, double{kLast}));
      std::memcpy(to + i * sizeof(number), &number, sizeof(number));
    }
  }
}

Position PositionCodec::decode(const std::byte* from) const {
  Position p = origin_;
  for (std::size_t i = 0; i < 3; ++i) {
    if (bits_ == 32) {
      float number;
      std::memcpy(&number, from + i * sizeof(number), sizeof(number));
      p[i] += number;
    } else {
      std::uint16_t number;
      std::memcpy(&number, from + i * sizeof(number), sizeof(number));
      p[i] = number == kNone ? kNaN : p[i] + step_[i] * number;
    }
  }
  return std::ranges::all_of(p, [](double x) { return std::isfinite(x); }) ? p : kNoPosition;
}

}  // namespace protomark
