// Sums up maps, and stores the positions of sealed ones.
#pragma once

#include "file/sections.h"
#include "map/row_table.h"

namespace protomark {

// Adds the position of a landmark to the summary of its map; NaN means that it has none.
inline void add_to_summary(MapSummary& summary, const Position& position) {
  if (std::isnan(position[0])) return;
  ++summary.landmarks_with_position;
  if (!summary.extent) summary.extent = {position, position};
  auto& [low, high] = *summary.extent;
  for (size_t i = 0; i < 3; ++i) {
    low[i] = std::min(low[i], position[i]);
    high[i] = std::max(high[i], position[i]);
  }
}

// Positions in 32 or 16 bits per coordinate: floats relative to an origin, or steps of a grid over
// the bounding box, with a step of its own along each axis.
class PositionCodec {
 public:
  PositionCodec() = default;
  // For positions in this box. Throws std::invalid_argument if it is too large for floats.
  PositionCodec(const std::array<Position, 2>& extent, int bits) : bits_(bits) {
    for (size_t i = 0; i < 3; ++i) {
      const double low = extent[0][i], high = extent[1][i], middle = low / 2 + high / 2;
      require(std::max(high - middle, middle - low) <= std::numeric_limits<float>::max(),
              "positions are too far apart for a sealed map");
      origin_[i] = bits == 16 ? low : middle;
      if (bits == 16) step_[i] = (high - low) / kLast;
    }
  }
  // Reads the steps if the file has any; `origin` is that of its shape. Throws FileError.
  PositionCodec(const ContainerReader& file, const Position& origin) : origin_(origin) {
    if (!file.has(section::kSteps)) return;
    bits_ = 16;
    step_ = read_value<Position>(file, section::kSteps);
    for (size_t i = 0; i < 3; ++i) {
      file.require(step_[i] >= 0 && std::isfinite(origin_[i] + step_[i] * kLast),
                   "the steps of its positions are impossible");
    }
  }

  int bits() const { return bits_; }
  size_t size() const { return 3 * static_cast<size_t>(bits_) / 8; }  // bytes
  const Position& origin() const { return origin_; }
  // The step along each axis; zeros with 32 bits.
  const Position& step() const { return step_; }

  // `to` and `from` are size() bytes.
  void encode(const Position& p, std::byte* to) const {
    for (size_t i = 0; i < 3; ++i) {
      const double distance = p[i] - origin_[i];
      if (bits_ == 32) {
        store(to + 4 * i, static_cast<float>(distance));
        continue;
      }
      const double steps = step_[i] > 0 ? std::round(distance / step_[i]) : 0;
      const double number = std::isnan(p[0]) ? kNone : std::clamp(steps, 0.0, double{kLast});
      store(to + 2 * i, static_cast<uint16_t>(number));
    }
  }
  // Returns NaN if there is no position, or no number in a broken file.
  Position decode(const std::byte* from) const {
    Position p = origin_;
    for (size_t i = 0; i < 3; ++i) {
      if (bits_ == 32) {
        p[i] += load<float>(from + 4 * i);
      } else {
        const auto number = load<uint16_t>(from + 2 * i);
        p[i] = number == kNone ? kNaN : p[i] + step_[i] * number;
      }
    }
    return is_finite(p) ? p : kNoPosition;
  }

 private:
  static constexpr uint16_t kLast = 65534;
  static constexpr uint16_t kNone = 65535;  // along all axes

  int bits_ = 32;
  Position origin_{};
  Position step_{};
};

}  // namespace protomark
