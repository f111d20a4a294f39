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
  const auto put = [&](auto number) {
    std::array<decltype(number(0)), 3> numbers;
    for (std::size_t i = 0; i < 3; ++i) numbers[i] = number(i);
    std::memcpy(to, &numbers, sizeof(numbers));
  };
  if (bits_ == 32) {
    put([&](std::size_t i) { return static_cast<float>(p[i] - origin_[i]); });
  } else {
    put([&](std::size_t i) {
      if (std::isnan(p[0])) return kNone;
      const double steps = step_[i] > 0 ? std::round((p[i] - origin_[i]) / step_[i]) : 0;
      return static_cast<std::uint16_t>(std::clamp(steps, 0.0, double{kLast}));
    });
  }
}

Position PositionCodec::decode(const std::byte* from) const {
  Position p = origin_;
  if (bits_ == 32) {
    std::array<float, 3> floats;
    std::memcpy(&floats, from, sizeof(floats));
    for (std::size_t i = 0; i < 3; ++i) p[i] += floats[i];
  } else {
    std::array<std::uint16_t, 3> steps;
    std::memcpy(&steps, from, sizeof(steps));
    for (std::size_t i = 0; i < 3; ++i)
      p[i] = steps[i] == kNone ? kNaN : p[i] + step_[i] * steps[i];
  }
  return std::ranges::all_of(p, [](double x) { return std::isfinite(x); }) ? p : kNoPosition;
}

}  // namespace protomark
