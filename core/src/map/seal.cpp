// PrototypeMap::seal: what a map knows, in as few bytes as were asked for. What is written comes
// into being while it is written, so that it takes little memory beside the map.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <functional>
#include <limits>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "base/quantize4.h"
#include "file/bit_numbers.h"
#include "file/container.h"
#include "file/ids.h"
#include "file/journal.h"
#include "file/labels.h"
#include "file/sections.h"
#include "map/landmark_numbers.h"
#include "map/place_writer.h"
#include "map/position_box.h"
#include "map/position_grid.h"
#include "map/prototype_store.h"
#include "map/seal_rows.h"
#include "map/sealed_ranks.h"
#include "search/coarse_quantizer.h"

namespace protomark {
namespace {

Occurrences occurrences(const SealedRows& rows) {
  Occurrences result{};
  std::vector<std::int8_t> code(rows.dim());
  rows.each_row([&](std::uint32_t row) {
    rows.code(row, code.data());
    for (const std::int8_t value : code) ++result[static_cast<std::uint8_t>(value + 128)];
  });
  return result;
}

// As 32-bit numbers from the origin. Throws std::invalid_argument where one is too far away.
std::array<float, 3> relative(const Position& position, const Position& origin) {
  std::array<float, 3> result;
  for (std::size_t i = 0; i < 3; ++i) {
    const double distance = position[i] - origin[i];
    if (std::abs(distance) > std::numeric_limits<float>::max()) {
      throw std::invalid_argument("positions are too far apart for a sealed map");
    }
    result[i] = static_cast<float>(distance);
  }
  return result;
}

// The sections that have something of every landmark or row. They come into being in one pass over
// landmarks by id and, with an index, another one over its cells.
class SealedContent {
 public:
  SealedContent(const SealedRows& rows, const BlockPacker& packer, bool ids_are_numbers)
      : rows_(&rows), packer_(&packer), numbered_(ids_are_numbers) {
    if (!indexed()) return;
    tests_.emplace(rows);
    if (!numbered_) numbers_.emplace(store());
  }

  // A section of one T for each landmark, value(number of the landmark in the map).
  template <typename T, typename Value>
  void add(const char* name, Value value) {
    parts_.push_back({name, store().landmarks() * sizeof(T)});
    put_.push_back([value](const ContainerWriter::Sink& sink, auto landmarks) {
      put_values<T>(sink, landmarks.size(), 1,
                    [&](std::size_t i, T* to) { *to = value(landmarks[i]); });
    });
  }

  // To a file that is written while this is there.
  void add_to(ContainerWriter& file) {
    const std::size_t n = store().landmarks();
    const std::size_t places = PlaceWriter::places(*rows_);
    const ContainerWriter::Part prototypes{section::kPrototypes,
                                           places / kPackedRows * packer_->size()};
    std::vector<ContainerWriter::Part> parts = parts_;
    if (!indexed()) parts.push_back(prototypes);
    if (!numbered_) {
      parts.push_back({section::kIdBlocks, IdBlockWriter::blocks_size(n)});
      parts.push_back({section::kIdRests, ContainerWriter::kUnknownSize});
    }
    file.add_together(std::move(parts), [this](auto sinks) { put_landmarks(sinks); });
    if (!indexed()) return;
    number_bits_ = std::bit_width(std::max<std::size_t>(n, 1));
    const std::size_t order_size = bit_numbers_size(places, number_bits_);
    file.add_together({prototypes, {section::kOrder, order_size}},
                      [this](auto sinks) { put_cells(sinks); });
    file.add(section::kOrderChecksums, order_checksums_size(order_size),
             [this](const auto& sink) { sink(std::as_bytes(std::span(order_checksums_.all()))); });
    const CoarseQuantizer& cells = store().cells();
    file.add(section::kCells, std::as_bytes(std::span(cells.centroids())));
    file.add(section::kCellRows, cells.nlist() * sizeof(std::uint32_t), [this](const auto& sink) {
      put_values<std::uint32_t>(
          sink, store().cells().nlist(), 1, [&](std::size_t c, std::uint32_t* to) {
            *to = static_cast<std::uint32_t>(rows_->rows_in(static_cast<std::uint32_t>(c)));
          });
    });
    file.add(section::kProbes, ContainerWriter::kUnknownSize, [this](const auto& sink) {
      const RecallTable measured = sealed_ranks(*rows_, *packer_, *tests_);
      sink(std::as_bytes(std::span(measured)));
    });
  }

 private:
  using Sinks = std::span<const ContainerWriter::Sink>;
  using Put = std::function<void(const ContainerWriter::Sink&, std::span<const std::uint32_t>)>;

  const PrototypeStore& store() const { return rows_->store(); }
  bool indexed() const { return store().cells().nlist() != 0; }

  void put_landmarks(Sinks sinks) {
    std::optional<PlaceWriter> places;
    if (!indexed()) places.emplace(*rows_, *packer_, sinks[put_.size()]);
    std::optional<IdBlockWriter> ids;
    if (!numbered_) ids.emplace(sinks[sinks.size() - 2], sinks.back());
    store().visit_sorted_landmarks([&](std::span<const std::uint32_t> landmarks) {
      for (std::size_t i = 0; i < put_.size(); ++i) put_[i](sinks[i], landmarks);
      for (const std::uint32_t landmark : landmarks) {
        if (ids) ids->add(store().ids()[landmark]);
        if (numbers_) numbers_->add(landmark);
        if (tests_) tests_->add(landmark);
        if (!places) continue;
        rows_->each_sorted_row(landmark, [&](std::uint32_t row) { places->add(row); });
      }
    });
    if (ids) ids->finish();
    if (!places) return;
    places->end_cell();
    places->finish();
  }

  void put_cells(Sinks sinks) {
    const ContainerWriter::Sink order = [&](Bytes bytes) {
      order_checksums_.add(bytes);
      sinks[1](bytes);
    };
    PlaceWriter places(*rows_, *packer_, sinks[0], order, numbers_, number_bits_);
    for (std::uint32_t c = 0; c < store().cells().nlist(); ++c) {
      rows_->visit_sorted_rows(c, [&](std::span<const std::uint32_t> piece) {
        for (const std::uint32_t row : piece) places.add(row);
      });
      places.end_cell();
    }
    places.finish();
    numbers_.reset();  // their memory is wanted for the test queries
  }

  const SealedRows* rows_;
  const BlockPacker* packer_;
  bool numbered_;
  std::vector<ContainerWriter::Part> parts_;
  std::vector<Put> put_;
  // With an index: its test queries, numbers of landmarks where these are not ids, and the order.
  std::optional<TestQueries> tests_;
  std::optional<LandmarkNumbers> numbers_;
  int number_bits_ = 0;
  OrderChecksums order_checksums_;
};

}  // namespace

void PrototypeMap::seal(const std::filesystem::path& path, int bits,
                        std::optional<double> prototypes, int position_bits) const {
  if (bits != 8 && bits != 4) {
    throw std::invalid_argument("prototypes are sealed with 8 or 4 bits a number, not " +
                                std::to_string(bits));
  }
  if (prototypes && !(*prototypes >= 1)) {
    throw std::invalid_argument("a map is sealed with at least 1 prototype a landmark, not " +
                                std::to_string(*prototypes));
  }
  if (position_bits != 32 && position_bits != 16) {
    throw std::invalid_argument("positions are sealed with 32 or 16 bits a coordinate, not " +
                                std::to_string(position_bits));
  }
  const JournalGuard guard(path);
  std::optional<JournalGuard> last;  // somebody may have begun a journal meanwhile
  const std::shared_lock changing(store_->changing);
  const PrototypeStore& store = *store_;
  const SealedRows rows(store, prototypes);
  const std::size_t n = store.landmarks();
  MapShape shape{n, dim_, {}};
  PositionBox box;
  for (const Position& position : store.positions()) box.add(position);
  const bool placed = box.placed != 0, gridded = placed && position_bits == 16;
  const PositionGrid grid = gridded ? PositionGrid(box) : PositionGrid();
  if (placed) {
    shape.origin = gridded ? grid.origin : box.middle();
    // Before anything is written; no position is further away than these.
    for (const Position& corner : {box.low, box.high}) relative(corner, box.middle());
  }
  const int half_step = bits == 4 ? best_half_step(occurrences(rows)) : 0;
  const BlockPacker packer(rows, half_step);
  const bool numbered =
      n == 0 || ids_are_numbers(n, *std::max_element(store.ids().begin(), store.ids().end()));

  ContainerWriter file(FileKind::sealed_map, !numbered || gridded          ? 4
                                             : store.cells().nlist() != 0  ? 3
                                             : bits == 4 || rows.several() ? 2
                                                                           : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  add_metadata(file, store_->metadata);
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  if (gridded) file.add(section::kSteps, write_steps(grid.step));

  SealedContent content(rows, packer, numbered);
  content.add<std::uint8_t>(section::kCounts, [&](std::uint32_t landmark) {
    return static_cast<std::uint8_t>(std::min(store.observations(landmark), 255u));
  });
  if (rows.several()) {
    content.add<std::uint8_t>(section::kRows, [&](std::uint32_t landmark) {
      return static_cast<std::uint8_t>(rows.rows_of(landmark));
    });
  }
  if (gridded) {
    content.add<PositionGrid::Cell>(section::kPositions, [&](std::uint32_t landmark) {
      return grid.cell(store.position(landmark));
    });
  } else if (placed) {
    content.add<std::array<float, 3>>(section::kPositions, [&](std::uint32_t landmark) {
      return relative(store.position(landmark), shape.origin);
    });
  }
  content.add_to(file);
  file.write(path, [&](const std::string&) { last.emplace(path); });
}

}  // namespace protomark
