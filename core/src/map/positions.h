// How far positions reach, and how a sealed map stores them.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>

#include "file/container.h"
#include "map/row_table.h"
#include "protomark/types.h"

namespace protomark {

// Adds a landmark to the summary of its map; NaN means that it has no position.
void add_to_summary(MapSummary& summary, std::uint32_t observations, const Position& position);

// Positions in 32 or 16 bits per coordinate. With 32 they are floats relative to an origin. With 16
// they are steps of a grid over the bounding box, which has a step of its own along each axis:
// along the longest one that is what a common step would be, and less along the others.
class PositionCodec {
 public:
  PositionCodec() = default;
  // For positions between these lowest and highest coordinates. Throws std::invalid_argument if
  // they are too far apart for floats.
  PositionCodec(const std::array<Position, 2>& extent, int bits);
  // Reads the steps, if the file has any; `origin` is that of its shape. Throws FileError.
  PositionCodec(const ContainerReader& file, const Position& origin);

  int bits() const { return bits_; }
  std::size_t size() const { return 3 * static_cast<std::size_t>(bits_) / 8; }  // bytes
  const Position& origin() const { return origin_; }
  // Steps along each axis; zeros with 32 bits.
  const Position& step() const { return step_; }

  // `to` and `from` are size() bytes.
  void encode(const Position& position, std::byte* to) const;
  // NaN if there is no position, or in a broken file no number.
  Position decode(const std::byte* from) const;

 private:
  static constexpr std::uint16_t kLast = 65534;
  static constexpr std::uint16_t kNone = 65535;  // along all axes

  int bits_ = 32;
  Position origin_{};
  Position step_{};
};

}  // namespace protomark
