// PrototypeMap::seal: what a map knows, in as few bytes as were asked for. What is written comes
// into being while it is written, so that it takes little memory beside the map.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <mutex>
#include <numeric>
#include <optional>
#include <shared_mutex>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "bit_numbers.h"
#include "cells.h"
#include "container.h"
#include "journal.h"
#include "landmark_ids.h"
#include "landmark_numbers.h"
#include "map_sections.h"
#include "position_box.h"
#include "position_grid.h"
#include "probe_ranks.h"
#include "prototype_store.h"
#include "quantize4.h"
#include "sealed_rows.h"
#include "top_k.h"

namespace protomark {
namespace {

constexpr std::uint32_t kPadding = UINT32_MAX;

// Blocks of kPackedRows rows as PackedPrototypes has them, or with a half-step as
// PackedPrototypes4.
class BlockPacker {
 public:
  BlockPacker(const SealedRows& rows, int half_step) : rows_(&rows), half_step_(half_step) {
    for (std::size_t i = 0; i < quantized_.size() && half_step_ != 0; ++i) {
      quantized_[i] = quantize4(static_cast<int>(i) - 128, half_step_);
    }
  }

  int half_step() const { return half_step_; }
  // Bytes of a block.
  std::size_t size() const {
    const std::size_t dim = rows_->dim();
    return half_step_ == 0 ? packed_size(kPackedRows, dim) : packed4_size(kPackedRows, dim);
  }
  // What is left of a number.
  int value(std::int8_t code) const { return half_step_ == 0 ? code : level4(u(code), half_step_); }

  // `rows` are kPackedRows numbers of rows, or kPadding.
  void pack(const std::uint32_t* rows, std::uint8_t* to) const {
    const std::size_t dim = rows_->dim();
    std::array<std::int8_t, 256> code;
    std::fill_n(to, size(), std::uint8_t{0});
    for (std::size_t i = 0; i < kPackedRows; ++i) {
      if (rows[i] == kPadding) continue;
      rows_->code(rows[i], code.data());
      for (std::size_t d = 0; d < dim && half_step_ == 0; d += 4) {
        std::memcpy(to + packed_index(i, d, dim), &code[d], std::min<std::size_t>(4, dim - d));
      }
      for (std::size_t d = 0; d < dim && half_step_ != 0; ++d) {
        std::uint8_t& byte = to[packed4_index(i, d, dim)];
        byte |= static_cast<std::uint8_t>(packed4_high(d) ? u(code[d]) << 4 : u(code[d]));
      }
    }
  }

 private:
  std::uint8_t u(std::int8_t code) const {
    return quantized_[static_cast<std::uint8_t>(code + 128)];
  }

  const SealedRows* rows_;
  int half_step_;  // 0: 8 bits a number
  std::array<std::uint8_t, 256> quantized_{};
};

// Rows in the order in which they stand in a sealed map: cell after cell, each from a new block on.
class PlaceWriter {
 public:
  // `order`, where there is one, gets the number of the landmark of each place, in so many bits:
  // its id, or what `numbers` says.
  PlaceWriter(const SealedRows& rows, const BlockPacker& packer,
              const ContainerWriter::Sink& prototypes)
      : rows_(&rows), packer_(&packer), prototypes_(&prototypes) {}
  PlaceWriter(const SealedRows& rows, const BlockPacker& packer,
              const ContainerWriter::Sink& prototypes, const ContainerWriter::Sink& order,
              const std::optional<LandmarkNumbers>& numbers, int bits)
      : PlaceWriter(rows, packer, prototypes) {
    order_ = &order;
    numbers_ = &numbers;
    bits_ = bits;
  }

  static std::size_t places(const SealedRows& rows, std::size_t cells) {
    std::size_t blocks = 0;
    for (std::uint32_t c = 0; c < cells; ++c) {
      blocks += (rows.rows_in(c) + kPackedRows - 1) / kPackedRows;
    }
    return blocks * kPackedRows;
  }

  void add(std::uint32_t row) {
    block_[filled_++] = row;
    if (filled_ == kPackedRows) end_block();
  }
  void end_cell() {
    if (filled_ == 0) return;
    std::fill(block_.begin() + static_cast<std::ptrdiff_t>(filled_), block_.end(), kPadding);
    end_block();
  }
  void finish() {
    flush();
    if (order_ == nullptr) return;
    const std::vector<std::uint8_t> behind(bit_numbers_size(0, bits_));
    (*order_)(std::as_bytes(std::span(behind)));
  }

 private:
  static constexpr std::size_t kPiece = 1 << 16;  // bytes

  void end_block() {
    packed_.resize(packed_.size() + packer_->size());
    packer_->pack(block_.data(), packed_.data() + packed_.size() - packer_->size());
    for (std::size_t i = 0; i < kPackedRows && order_ != nullptr; ++i) {
      landmarks_.push_back(number(block_[i]));
    }
    filled_ = 0;
    if (packed_.size() >= kPiece) flush();
  }

  std::uint32_t number(std::uint32_t row) const {
    const PrototypeStore& store = rows_->store();
    if (row == kPadding) return static_cast<std::uint32_t>(store.landmarks());
    const std::uint32_t landmark = rows_->landmark_of(row);
    return *numbers_ ? (**numbers_)[landmark] : static_cast<std::uint32_t>(store.ids()[landmark]);
  }

  void flush() {
    (*prototypes_)(std::as_bytes(std::span(packed_)));
    packed_.clear();
    if (order_ == nullptr) return;
    // Of a multiple of 8 numbers, so that pieces follow each other.
    const std::vector<std::uint8_t> numbers = pack_bit_numbers(landmarks_, bits_);
    const std::size_t behind = bit_numbers_size(0, bits_);
    (*order_)(std::as_bytes(std::span(numbers)).first(numbers.size() - behind));
    landmarks_.clear();
  }

  const SealedRows* rows_;
  const BlockPacker* packer_;
  const ContainerWriter::Sink* prototypes_;
  const ContainerWriter::Sink* order_ = nullptr;
  const std::optional<LandmarkNumbers>* numbers_ = nullptr;
  int bits_ = 0;
  std::array<std::uint32_t, kPackedRows> block_{};
  std::size_t filled_ = 0;
  std::vector<std::uint8_t> packed_;
  std::vector<std::uint32_t> landmarks_;  // of each place, as numbers
};

// Offers the two nearest landmarks of each query, found in so many rows at a time, to `offer(query,
// id of the landmark)`.
template <typename Offer>
void search_in_pieces(const SealedRows& rows, const BlockPacker& packer, Codes queries,
                      const Offer& offer) {
  constexpr std::size_t kPiece = 1 << 13;
  const PrototypeStore& store = rows.store();
  LargeVector<std::uint8_t> packed(kPiece / kPackedRows * packer.size());
  std::vector<std::uint32_t> piece;
  std::vector<std::int64_t> ids(2 * queries.rows), landmarks;
  std::vector<float> distances(ids.size());
  std::vector<std::uint32_t> itself(kPiece);  // several rows may have the same id
  std::iota(itself.begin(), itself.end(), 0u);
  piece.reserve(kPiece);
  landmarks.reserve(kPiece);
  const auto search_piece = [&] {
    const std::size_t n = piece.size();
    if (n == 0) return;
    piece.resize((n + kPackedRows - 1) / kPackedRows * kPackedRows, kPadding);
    for (std::size_t begin = 0; begin < n; begin += kPackedRows) {
      packer.pack(&piece[begin], &packed[begin / kPackedRows * packer.size()]);
    }
    RowLandmarks numbers;
    numbers.of_row = itself.data();
    const MatrixView<std::int64_t> nearest{ids.data(), queries.rows, 2};
    const MatrixView<float> unused{distances.data(), queries.rows, 2};
    const auto find = [&](const auto& prototypes) {
      search(prototypes, queries, {}, nearest, unused);
    };
    if (packer.half_step() == 0) {
      const auto* codes = reinterpret_cast<const std::int8_t*>(packed.data());
      find(PackedPrototypes{codes, n, rows.dim(), landmarks.data(), numbers});
    } else {
      find(PackedPrototypes4{packed.data(), n, rows.dim(), packer.half_step(), landmarks.data(),
                             numbers});
    }
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (ids[i] >= 0) offer(i / 2, ids[i]);
    }
    piece.clear();
    landmarks.clear();
  };
  rows.each_row([&](std::uint32_t row) {
    piece.push_back(row);
    landmarks.push_back(store.ids()[rows.landmark_of(row)]);
    if (piece.size() == kPiece) search_piece();
  });
  search_piece();
}

// The test queries that say how well the cells of a sealed map serve it: rows of test_rows, as
// landmarks come by id.
class TestQueries {
 public:
  explicit TestQueries(const SealedRows& rows)
      : rows_(&rows),
        tests_(test_rows(rows.size())),
        by_row_(tests_.size()),
        codes_(tests_.size() * rows.dim()),
        own_(tests_.size()) {
    std::iota(by_row_.begin(), by_row_.end(), std::size_t{0});
    std::sort(by_row_.begin(), by_row_.end(),
              [&](std::size_t a, std::size_t b) { return tests_[a] < tests_[b]; });
  }

  void add(std::uint32_t landmark) {
    const std::size_t end = row_ + rows_->rows_of(landmark);
    for (; next_ < by_row_.size() && tests_[by_row_[next_]] < end; ++next_) {
      const std::size_t i = by_row_[next_];
      rows_->code(rows_->sorted_rows(landmark)[tests_[i] - row_], &codes_[i * rows_->dim()]);
      own_[i] = rows_->store().ids()[landmark];
    }
    row_ = end;
  }

  Codes codes() const { return {codes_.data(), tests_.size(), rows_->dim()}; }
  // The id of the landmark of each.
  const std::vector<std::int64_t>& own() const { return own_; }

 private:
  const SealedRows* rows_;
  std::vector<std::size_t> tests_, by_row_;
  std::vector<std::int8_t> codes_;
  std::vector<std::int64_t> own_;
  std::size_t row_ = 0, next_ = 0;
};

// How well the cells of a sealed map serve it.
ProbeRanks ranks(const SealedRows& rows, const BlockPacker& packer, const TestQueries& tests,
                 const Cells& cells) {
  const std::size_t dim = rows.dim();
  struct Nearest {
    std::int32_t distance = INT32_MAX;
    std::uint32_t row = 0;
  };
  const auto nearest_row = [&](std::int64_t id, const std::int8_t* query) {
    std::array<std::int8_t, 256> code;
    Nearest result;
    for (const std::uint32_t row : rows.sorted_rows(rows.store().at(id))) {
      rows.code(row, code.data());
      std::int32_t distance = 0;
      for (std::size_t d = 0; d < dim; ++d) {
        const int difference = query[d] - packer.value(code[d]);
        distance += difference * difference;
      }
      if (distance < result.distance) result = {distance, row};
    }
    return result;
  };
  const auto search_two = [&](Codes queries, MatrixView<std::int64_t> ids, MatrixView<float>) {
    std::vector<std::int32_t> distances(2 * queries.rows);
    std::vector<TopK> best;
    for (std::size_t q = 0; q < queries.rows; ++q) {
      best.emplace_back(ids.row(q), &distances[2 * q], 2, INT32_MAX - 1);
    }
    // Floats do not tell all distances apart.
    search_in_pieces(rows, packer, queries, [&](std::size_t q, std::int64_t id) {
      best[q].offer_distinct(nearest_row(id, queries.row(q)).distance, id);
    });
  };
  const auto cell_of = [&](std::int64_t id, const std::int8_t* query) {
    return rows.cell_of(nearest_row(id, query).row);
  };
  return measure_ranks(tests.codes(), tests.own(), cells.centroids(), search_two, cell_of);
}

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

// What is written of each landmark, by id.
struct LandmarkContent {
  std::vector<ContainerWriter::Part> parts;
  // Of these, and of some landmarks.
  std::vector<std::function<void(const ContainerWriter::Sink&, std::span<const std::uint32_t>)>>
      put;

  // A section of one T for each landmark.
  template <typename T, typename Value>
  void add(const char* name, std::size_t n, Value value) {
    parts.push_back({name, n * sizeof(T)});
    put.push_back([value](const ContainerWriter::Sink& sink, auto landmarks) {
      put_values<T>(sink, landmarks.size(), 1,
                    [&](std::size_t i, T* to) { *to = value(landmarks[i]); });
    });
  }
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
  const Cells& cells = store.cells();
  const bool indexed = cells.size() != 0;
  const std::size_t places = PlaceWriter::places(rows, std::max<std::size_t>(cells.size(), 1));
  const std::size_t prototypes_size = places / kPackedRows * packer.size();
  const bool numbered =
      n == 0 || ids_are_numbers(n, *std::max_element(store.ids().begin(), store.ids().end()));

  ContainerWriter file(FileKind::sealed_map, !numbered || gridded          ? 4
                                             : indexed                     ? 3
                                             : bits == 4 || rows.several() ? 2
                                                                           : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  add_metadata(file, store_->metadata);
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  if (gridded) file.add(section::kSteps, write_steps(grid.step));

  LandmarkContent of_landmarks;
  of_landmarks.add<std::uint8_t>(section::kCounts, n, [&](std::uint32_t landmark) {
    return static_cast<std::uint8_t>(std::min(store.observations(landmark), 255u));
  });
  if (rows.several()) {
    of_landmarks.add<std::uint8_t>(section::kRows, n, [&](std::uint32_t landmark) {
      return static_cast<std::uint8_t>(rows.rows_of(landmark));
    });
  }
  if (gridded) {
    of_landmarks.add<PositionGrid::Cell>(section::kPositions, n, [&](std::uint32_t landmark) {
      return grid.cell(store.position(landmark));
    });
  } else if (placed) {
    of_landmarks.add<std::array<float, 3>>(section::kPositions, n, [&](std::uint32_t landmark) {
      return relative(store.position(landmark), shape.origin);
    });
  }
  std::vector<ContainerWriter::Part> parts = of_landmarks.parts;
  if (!indexed) parts.push_back({section::kPrototypes, prototypes_size});
  if (!numbered) {
    parts.push_back({section::kIdBlocks, IdBlockWriter::blocks_size(n)});
    parts.push_back({section::kIdRests, ContainerWriter::kUnknownSize});
  }
  std::optional<LandmarkNumbers> numbers;
  std::optional<TestQueries> tests;
  if (indexed) tests.emplace(rows);
  if (indexed && !numbered) numbers.emplace(store);
  file.add_together(std::move(parts), [&](std::span<const ContainerWriter::Sink> sinks) {
    const std::size_t prototypes_at = of_landmarks.put.size();
    std::optional<PlaceWriter> places_to;
    if (!indexed) places_to.emplace(rows, packer, sinks[prototypes_at]);
    std::optional<IdBlockWriter> ids_to;
    if (!numbered) ids_to.emplace(sinks[sinks.size() - 2], sinks.back());
    store.visit_sorted_landmarks([&](std::span<const std::uint32_t> landmarks) {
      for (std::size_t i = 0; i < prototypes_at; ++i) of_landmarks.put[i](sinks[i], landmarks);
      for (const std::uint32_t landmark : landmarks) {
        if (ids_to) ids_to->add(store.ids()[landmark]);
        if (numbers) numbers->add(landmark);
        if (tests) tests->add(landmark);
        if (!places_to) continue;
        rows.each_sorted_row(landmark, [&](std::uint32_t row) { places_to->add(row); });
      }
    });
    if (ids_to) ids_to->finish();
    if (!places_to) return;
    places_to->end_cell();
    places_to->finish();
  });
  if (indexed) {
    const int number_bits = std::bit_width(std::max<std::size_t>(n, 1));
    std::vector<std::uint32_t> cell_rows;
    for (std::uint32_t c = 0; c < cells.size(); ++c) {
      cell_rows.push_back(static_cast<std::uint32_t>(rows.rows_in(c)));
    }
    file.add_together({{section::kPrototypes, prototypes_size},
                       {section::kOrder, bit_numbers_size(places, number_bits)}},
                      [&, number_bits](std::span<const ContainerWriter::Sink> sinks) {
                        PlaceWriter to(rows, packer, sinks[0], sinks[1], numbers, number_bits);
                        for (std::uint32_t c = 0; c < cells.size(); ++c) {
                          rows.visit_sorted_rows(c, [&](std::span<const std::uint32_t> piece) {
                            for (const std::uint32_t row : piece) to.add(row);
                          });
                          to.end_cell();
                        }
                        to.finish();
                        numbers.reset();
                      });
    file.add(section::kCells, std::as_bytes(std::span(cells.centroids())));
    file.add(section::kCellRows, cell_rows.size() * sizeof(std::uint32_t),
             [cell_rows](const ContainerWriter::Sink& sink) {
               sink(std::as_bytes(std::span(cell_rows)));
             });
    file.add(section::kProbes, ContainerWriter::kUnknownSize,
             [&](const ContainerWriter::Sink& sink) {
               const ProbeRanks measured = ranks(rows, packer, *tests, cells);
               sink(std::as_bytes(std::span(measured)));
             });
  }
  file.write(path, [&](const std::string&) { last.emplace(path); });
}

}  // namespace protomark
