// Sums up maps, and stores the positions of sealed ones.
#pragma once

#include "file/container.h"
#include "map/row_table.h"
#include "protomark/types.h"

namespace protomark {

// Adds a landmark to the summary of its map; NaN means that it has no position.
void add_to_summary(MapSummary& summary, std::uint32_t observations, const Position& position);

// Positions in 32 or 16 bits per coordinate: floats relative to an origin, or steps of a grid over
// the bounding box, with a step of its own along each axis.
class PositionCodec {
 public:
  PositionCodec() = default;
  // For positions between these lowest and highest coordinates. Throws std::invalid_argument if
  // they are too far apart for floats.
  PositionCodec(const std::array<Position, 2>& extent, int bits);
  // Reads the steps if the file has any; `origin` is that of its shape. Throws FileError.
  PositionCodec(const ContainerReader& file, const Position& origin);

  int bits() const { return bits_; }
  std::size_t size() const { return 3 * static_cast<std::size_t>(bits_) / 8; }  // bytes
  const Position& origin() const { return origin_; }
  // The step along each axis; zeros with 32 bits.
  const Position& step() const { return step_; }

  // `to` and `from` are size() bytes.
  void encode(const Position& position, std::byte* to) const;
  // Returns NaN if there is no position, or no number in a broken file.
  Position decode(const std::byte* from) const;

 private:
  static constexpr std::uint16_t kLast = 65534;
  static constexpr std::uint16_t kNone = 65535;  // along all axes

  int bits_ = 32;
  Position origin_{};
  Position step_{};
};

}  // namespace protomark
