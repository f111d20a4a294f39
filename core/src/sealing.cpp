// PrototypeMap::seal: what a map knows, in as few bytes as were asked for. Beside the map it takes
// 8 bytes a row: what is written comes into being while it is written.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <mutex>
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

// Where the rows of a sealed map stand: cell after cell, each from a new block on.
class Places {
 public:
  Places(const SealedRows& rows, std::size_t cells) : cell_rows_(cells, 0), rows_(rows.size()) {
    for (std::size_t row = 0; row < rows_; ++row) ++cell_rows_[rows.cell_of(row)];
    std::vector<std::size_t> next(cells);
    for (std::size_t c = 0; c < cells; ++c) {
      next[c] = size_;
      size_ += (cell_rows_[c] + kPackedRows - 1) / kPackedRows * kPackedRows;
    }
    if (cells == 1) return;
    row_at_.assign(size_, kPadding);
    for (std::size_t row = 0; row < rows_; ++row) {
      row_at_[next[rows.cell_of(row)]++] = static_cast<std::uint32_t>(row);
    }
  }

  std::size_t size() const { return size_; }
  // The row of a place, or kPadding.
  std::uint32_t row_at(std::size_t place) const {
    if (!row_at_.empty()) return row_at_[place];
    return place < rows_ ? static_cast<std::uint32_t>(place) : kPadding;
  }
  // Rows of a block of kPackedRows places.
  std::array<std::uint32_t, kPackedRows> block(std::size_t number) const {
    std::array<std::uint32_t, kPackedRows> result;
    for (std::size_t i = 0; i < kPackedRows; ++i) result[i] = row_at(number * kPackedRows + i);
    return result;
  }
  const std::vector<std::uint32_t>& cell_rows() const { return cell_rows_; }

 private:
  std::vector<std::uint32_t> cell_rows_;  // of each cell
  std::size_t rows_;
  std::size_t size_ = 0;
  std::vector<std::uint32_t> row_at_;  // empty where all is one cell
};

// Offers the two nearest landmarks of each query, found in so many rows at a time, to `offer(query,
// landmark)`.
template <typename Offer>
void search_in_pieces(const SealedRows& rows, const BlockPacker& packer, Codes queries,
                      const Offer& offer) {
  constexpr std::size_t kPiece = 1 << 16;
  const std::size_t most = std::min(rows.size(), kPiece);
  LargeVector<std::uint8_t> packed((most + kPackedRows - 1) / kPackedRows * packer.size());
  std::vector<std::uint32_t> landmarks(most);
  std::vector<std::int64_t> ids(2 * queries.rows);
  std::vector<float> distances(ids.size());
  for (std::size_t first = 0; first < rows.size(); first += kPiece) {
    const std::size_t n = std::min(kPiece, rows.size() - first);
    for (std::size_t begin = 0; begin < n; begin += kPackedRows) {
      std::array<std::uint32_t, kPackedRows> block;
      for (std::size_t i = 0; i < kPackedRows; ++i) {
        const auto row = static_cast<std::uint32_t>(first + begin + i);
        block[i] = begin + i < n ? row : kPadding;
        if (begin + i < n) landmarks[begin + i] = static_cast<std::uint32_t>(rows.landmark_of(row));
      }
      packer.pack(block.data(), &packed[begin / kPackedRows * packer.size()]);
    }
    RowLandmarks numbers;
    numbers.of_row = landmarks.data();
    const MatrixView<std::int64_t> nearest{ids.data(), queries.rows, 2};
    const MatrixView<float> unused{distances.data(), queries.rows, 2};
    const auto find = [&](const auto& prototypes) {
      search(prototypes, queries, {}, nearest, unused);
    };
    if (packer.half_step() == 0) {
      const auto* codes = reinterpret_cast<const std::int8_t*>(packed.data());
      find(PackedPrototypes{codes, n, rows.dim(), nullptr, numbers});
    } else {
      find(PackedPrototypes4{packed.data(), n, rows.dim(), packer.half_step(), nullptr, numbers});
    }
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (ids[i] >= 0) offer(i / 2, ids[i]);
    }
  }
}

// How well the cells of a sealed map serve it.
ProbeRanks ranks(const SealedRows& rows, const BlockPacker& packer, const Cells& cells) {
  const std::size_t dim = rows.dim();
  const std::vector<std::size_t> tests = test_rows(rows.size());
  std::vector<std::int8_t> codes(tests.size() * dim);
  std::vector<std::int64_t> own;
  for (std::size_t i = 0; i < tests.size(); ++i) {
    rows.code(tests[i], &codes[i * dim]);
    own.push_back(static_cast<std::int64_t>(rows.landmark_of(tests[i])));
  }

  struct Nearest {
    std::int32_t distance = INT32_MAX;
    std::size_t row = 0;
  };
  const auto nearest_row = [&](std::int64_t landmark, const std::int8_t* query) {
    std::array<std::int8_t, 256> code;
    Nearest result;
    const auto i = static_cast<std::size_t>(landmark);
    for (std::size_t row = rows.first_row(i); row < rows.first_row(i + 1); ++row) {
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
    search_in_pieces(rows, packer, queries, [&](std::size_t q, std::int64_t landmark) {
      best[q].offer_distinct(nearest_row(landmark, queries.row(q)).distance, landmark);
    });
  };
  const auto cell_of = [&](std::int64_t landmark, const std::int8_t* query) {
    return rows.cell_of(nearest_row(landmark, query).row);
  };
  return measure_ranks({codes.data(), own.size(), dim}, own, cells.centroids(), search_two,
                       cell_of);
}

Occurrences occurrences(const SealedRows& rows) {
  Occurrences result{};
  std::vector<std::int8_t> code(rows.dim());
  for (std::size_t row = 0; row < rows.size(); ++row) {
    rows.code(row, code.data());
    for (const std::int8_t value : code) ++result[static_cast<std::uint8_t>(value + 128)];
  }
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

// Section `order`: pack_bit_numbers of the landmark of each place.
void write_order(const SealedRows& rows, const Places& places, int bits,
                 const ContainerWriter::Sink& sink) {
  constexpr std::size_t kPiece = 1 << 16;  // a multiple of 8, so that pieces follow each other
  const std::size_t all = places.size();
  std::vector<std::uint32_t> numbers;
  std::size_t first = 0;
  do {
    const std::size_t end = std::min(all, first + kPiece);
    numbers.clear();
    for (; first < end; ++first) {
      const std::uint32_t row = places.row_at(first);
      numbers.push_back(static_cast<std::uint32_t>(row == kPadding ? rows.landmarks().size()
                                                                   : rows.landmark_of(row)));
    }
    const std::vector<std::uint8_t> packed = pack_bit_numbers(numbers, bits);
    const std::size_t behind = first < all ? bit_numbers_size(0, bits) : 0;
    sink(std::as_bytes(std::span(packed)).first(packed.size() - behind));
  } while (first < all);
}

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
  const SealedRows rows(*store_, prototypes);
  const std::vector<std::uint32_t>& landmarks = rows.landmarks();
  const std::size_t n = landmarks.size();
  const auto id = [&](std::size_t i) { return store_->ids()[landmarks[i]]; };
  MapShape shape{n, dim_, {}};
  PositionBox box;
  for (const Position& position : store_->positions()) box.add(position);
  const bool placed = box.placed != 0, gridded = placed && position_bits == 16;
  const PositionGrid grid = gridded ? PositionGrid(box) : PositionGrid();
  if (placed) {
    shape.origin = gridded ? grid.origin : box.middle();
    // Before anything is written; no position is further away than these.
    for (const Position& corner : {box.low, box.high}) relative(corner, box.middle());
  }
  const int half_step = bits == 4 ? best_half_step(occurrences(rows)) : 0;
  const BlockPacker packer(rows, half_step);
  const Cells& cells = store_->cells();
  const bool indexed = cells.size() != 0;
  const Places places(rows, std::max<std::size_t>(cells.size(), 1));
  const ProbeRanks probe_ranks = indexed ? ranks(rows, packer, cells) : ProbeRanks();
  const bool numbered = n == 0 || ids_are_numbers(n, id(n - 1));

  ContainerWriter file(FileKind::sealed_map, !numbered || gridded          ? 4
                                             : indexed                     ? 3
                                             : bits == 4 || rows.several() ? 2
                                                                           : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  add_metadata(file, store_->metadata);
  add_ids(file, n, id);
  add_values<std::uint8_t>(file, section::kCounts, n, 1, [&](std::size_t i, std::uint8_t* to) {
    *to = static_cast<std::uint8_t>(std::min(store_->observations(landmarks[i]), 255u));
  });
  if (rows.several()) {
    add_values<std::uint8_t>(file, section::kRows, n, 1, [&](std::size_t i, std::uint8_t* to) {
      *to = static_cast<std::uint8_t>(rows.first_row(i + 1) - rows.first_row(i));
    });
  }
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  add_values<std::uint8_t>(
      file, section::kPrototypes, places.size() / kPackedRows, packer.size(),
      [&](std::size_t block, std::uint8_t* to) { packer.pack(places.block(block).data(), to); });
  if (gridded) {
    file.add(section::kSteps, write_steps(grid.step));
    add_values<PositionGrid::Cell>(file, section::kPositions, n, 1,
                                   [&](std::size_t i, PositionGrid::Cell* to) {
                                     *to = grid.cell(store_->position(landmarks[i]));
                                   });
  } else if (placed) {
    using Relative = std::array<float, 3>;
    add_values<Relative>(file, section::kPositions, n, 1, [&](std::size_t i, Relative* to) {
      *to = relative(store_->position(landmarks[i]), shape.origin);
    });
  }
  if (indexed) {
    file.add(section::kCells, std::as_bytes(std::span(cells.centroids())));
    file.add(section::kCellRows, std::as_bytes(std::span(places.cell_rows())));
    const int number_bits = std::bit_width(std::max<std::size_t>(n, 1));
    file.add(section::kOrder, bit_numbers_size(places.size(), number_bits),
             [&, number_bits](const ContainerWriter::Sink& sink) {
               write_order(rows, places, number_bits, sink);
             });
    file.add(section::kProbes, std::as_bytes(std::span(probe_ranks)));
  }
  file.write(path, [&](const std::string&) { last.emplace(path); });
}

}  // namespace protomark
