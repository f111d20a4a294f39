#include "file/sections.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "base/quantize4.h"
#include "map/position_grid.h"
#include "search/coarse_quantizer.h"

namespace protomark {

std::vector<std::byte> write_shape(const MapShape& shape) {
  SectionWriter out;
  out.value(static_cast<std::uint64_t>(shape.landmarks));
  out.value(static_cast<std::uint64_t>(shape.dim));
  out.values(shape.origin.data(), shape.origin.size());
  return out.take();
}

MapShape read_shape(const ContainerReader& file, const Encoder& encoder) {
  SectionReader in(file, section::kShape);
  MapShape shape;
  shape.landmarks = in.value<std::uint64_t>();
  shape.dim = in.value<std::uint64_t>();
  in.copy(shape.origin.data(), shape.origin.size());
  in.finish();
  if (shape.landmarks > UINT32_MAX) file.fail("it claims more landmarks than a map can hold");
  const auto& dims = encoder.dims();
  if (std::find(dims.begin(), dims.end(), shape.dim) == dims.end()) {
    file.fail("its dimension does not fit its encoder");
  }
  if (!std::all_of(shape.origin.begin(), shape.origin.end(),
                   [](double x) { return std::isfinite(x); })) {
    file.fail("its origin is not finite");
  }
  return shape;
}

std::vector<std::byte> write_levels(int half_step) {
  SectionWriter out;
  out.value(std::uint32_t{4});
  out.value(static_cast<std::uint32_t>(half_step));
  return out.take();
}

int read_levels(const ContainerReader& file) {
  SectionReader in(file, section::kLevels);
  const auto bits = in.value<std::uint32_t>();
  const auto half_step = in.value<std::uint32_t>();
  in.finish();
  if (bits != 4) {
    file.fail("its prototypes have " + std::to_string(bits) +
              " bits a number, this Protomark reads 8 and 4");
  }
  if (half_step < 1 || half_step > kMaxScale) {
    file.fail("the half-step of its prototypes is " + std::to_string(half_step) + ", not 1 to " +
              std::to_string(kMaxScale));
  }
  return static_cast<int>(half_step);
}

std::shared_ptr<const Encoder> read_encoder(const ContainerReader& file) {
  return std::make_shared<const Encoder>(
      Encoder::parse(file.read(section::kEncoder), file.name() + ": encoder"));
}

std::vector<std::byte> write_look_bits(std::size_t look_bits) {
  SectionWriter out;
  out.value(static_cast<std::uint32_t>(look_bits));
  return out.take();
}

std::size_t read_look_bits(const ContainerReader& file, std::size_t dim) {
  if (!file.map_if_there(section::kLookBits)) return 0;
  SectionReader in(file, section::kLookBits);
  const auto look_bits = in.value<std::uint32_t>();
  in.finish();
  const std::size_t most = std::min(PrototypeMap::kMaxLookBits, dim);
  if (look_bits == 0 || look_bits > most) {
    file.fail("its looks have " + std::to_string(look_bits) + " bits, not 1 to " +
              std::to_string(most));
  }
  return look_bits;
}

std::vector<std::int8_t> read_cells(const ContainerReader& file, std::size_t dim) {
  const auto bytes = file.map_if_there(section::kCells);
  if (!bytes) return {};
  const std::size_t cells = bytes->size() / dim;
  if (cells == 0 || cells > CoarseQuantizer::kMaxLists || bytes->size() != cells * dim) {
    file.fail("its section 'cells' has the wrong size");
  }
  auto centroids = read_section<std::int8_t>(file, section::kCells, cells * dim);
  if (std::find(centroids.begin(), centroids.end(), -128) != centroids.end()) {
    file.fail("its cells have impossible centroids");
  }
  return centroids;
}

void check_ids(const ContainerReader& file, std::span<const std::int64_t> ids) {
  if (!ids.empty() && ids.front() < 0) file.fail("it has a negative landmark id");
  for (std::size_t i = 1; i < ids.size(); ++i) {
    if (ids[i] <= ids[i - 1]) file.fail("its landmark ids do not ascend");
  }
}

std::vector<std::byte> write_steps(const Position& step) {
  SectionWriter out;
  out.values(step.data(), step.size());
  return out.take();
}

Position read_steps(const ContainerReader& file, const Position& origin) {
  SectionReader in(file, section::kSteps);
  Position step;
  in.copy(step.data(), step.size());
  in.finish();
  for (std::size_t i = 0; i < 3; ++i) {
    if (!(step[i] >= 0) || !std::isfinite(origin[i] + step[i] * PositionGrid::kLast)) {
      file.fail("the steps of its positions are impossible");
    }
  }
  return step;
}

}  // namespace protomark
