#include "map/positions.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "file/sections.h"

namespace protomark {

void PositionBox::add(const Position& p) {
  if (std::isnan(p[0])) return;
  for (std::size_t i = 0; i < 3; ++i) {
    low[i] = positions != 0 ? std::min(low[i], p[i]) : p[i];
    high[i] = positions != 0 ? std::max(high[i], p[i]) : p[i];
  }
  ++positions;
}

Position PositionBox::middle() const {
  return {low[0] / 2 + high[0] / 2, low[1] / 2 + high[1] / 2, low[2] / 2 + high[2] / 2};
}

PositionCodec::PositionCodec(const PositionBox& box, int bits) : bits_(bits) {
  const Position middle = box.middle();
  origin_ = bits == 16 ? box.low : middle;
  for (std::size_t i = 0; i < 3; ++i) {
    const double reach = std::max(box.high[i] - middle[i], middle[i] - box.low[i]);
    if (reach > std::numeric_limits<float>::max()) {
      invalid("positions are too far apart for a sealed map");
    }
    if (bits == 16) step_[i] = (box.high[i] - box.low[i]) / kLast;
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

void SummaryBuilder::add(std::uint32_t observations, const Position& position) {
  summary_.observations += observations;
  ++summary_.landmarks_by_count[std::min(observations, 255u)];
  box_.add(position);
}

MapSummary SummaryBuilder::take() {
  summary_.landmarks_with_position = box_.positions;
  summary_.low = box_.low;
  summary_.high = box_.high;
  return summary_;
}

}  // namespace protomark
