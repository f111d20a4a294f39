// PrototypeMap::seal: what a map knows, in as few bytes as were asked for.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <functional>
#include <limits>
#include <mutex>
#include <queue>
#include <stdexcept>
#include <string>
#include <utility>

#include "bit_numbers.h"
#include "cells.h"
#include "container.h"
#include "map_sections.h"
#include "probe_ranks.h"
#include "prototype_store.h"
#include "quantize4.h"
#include "rounded_mean.h"
#include "ward.h"

namespace protomark {
namespace {

// A sealed map has a byte for the number of a landmark's prototypes.
constexpr std::size_t kMaxRows = 255;

// Rounded prototypes in the order of landmarks.
struct Rounded {
  std::size_t rows = 0;
  std::vector<std::int8_t> codes;     // rows x dim
  std::vector<std::uint8_t> rows_of;  // of each landmark
};

// Sums and counts of one landmark's rows.
struct LandmarkRows {
  LandmarkRows(const PrototypeStore& store, std::uint32_t landmark) {
    for (const std::uint32_t row : store.sorted_rows(landmark)) {
      sums.insert(sums.end(), store.sum(row), store.sum(row) + store.dim());
      counts.push_back(store.count(row));
    }
  }
  std::vector<std::int16_t> sums;
  std::vector<std::uint8_t> counts;
};

// The joins of all landmarks, and how many of each one's are made.
class Joins {
 public:
  // The cheapest first over the whole map, of equals that of the first landmark, until there are at
  // most `most` rows.
  Joins(const PrototypeStore& store, const std::vector<std::uint32_t>& landmarks, double most)
      : ends_(landmarks.size()), made_(landmarks.size()) {
    std::size_t rows = store.rows();
    using Next = std::pair<double, std::size_t>;  // cost, number of the landmark
    std::vector<Next> first;
    for (std::size_t i = 0; i < landmarks.size(); ++i) {
      const LandmarkRows own(store, landmarks[i]);
      const auto joins = ward_joins(own.sums, own.counts, store.dim());
      joins_.insert(joins_.end(), joins.begin(), joins.end());
      ends_[i] = joins_.size();
      if (own.counts.size() > kMaxRows) made_[i] = own.counts.size() - kMaxRows;
      rows -= made_[i];
      if (made_[i] < joins.size()) first.emplace_back(of(i)[made_[i]].cost, i);
    }
    std::priority_queue next(std::greater<>(), std::move(first));
    for (; static_cast<double>(rows) > most && !next.empty(); --rows) {
      const std::size_t i = next.top().second;
      next.pop();
      if (++made_[i] < of(i).size()) next.emplace(of(i)[made_[i]].cost, i);
    }
  }

  std::span<const Join> made(std::size_t i) const { return of(i).first(made_[i]); }

 private:
  std::span<const Join> of(std::size_t i) const {
    const std::size_t begin = i == 0 ? 0 : ends_[i - 1];
    return std::span(joins_).subspan(begin, ends_[i] - begin);
  }

  std::vector<Join> joins_;
  std::vector<std::size_t> ends_;  // of each landmark's joins
  std::vector<std::size_t> made_;
};

Rounded joined(const PrototypeStore& store, const std::vector<std::uint32_t>& landmarks,
               const Joins& joins) {
  const std::size_t dim = store.dim();
  Rounded result;
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkRows own(store, landmarks[i]);
    std::vector<std::int64_t> sums(own.sums.begin(), own.sums.end());
    std::vector<std::int64_t> counts(own.counts.begin(), own.counts.end());
    for (const Join& join : joins.made(i)) {
      for (std::size_t d = 0; d < dim; ++d) sums[join.into * dim + d] += sums[join.from * dim + d];
      counts[join.into] += std::exchange(counts[join.from], 0);
    }
    for (std::size_t row = 0; row < counts.size(); ++row) {
      if (counts[row] == 0) continue;
      for (std::size_t d = 0; d < dim; ++d) {
        result.codes.push_back(rounded_mean(sums[row * dim + d], counts[row]));
      }
    }
    const std::size_t rows = counts.size() - joins.made(i).size();
    result.rows_of.push_back(static_cast<std::uint8_t>(rows));
    result.rows += rows;
  }
  return result;
}

Rounded as_they_are(const PrototypeStore& store, const std::vector<std::uint32_t>& landmarks) {
  Rounded result;
  result.rows = store.rows();
  result.codes.reserve(store.rows() * store.dim());
  for (const std::uint32_t landmark : landmarks) {
    const auto rows = store.sorted_rows(landmark);
    result.rows_of.push_back(static_cast<std::uint8_t>(rows.size()));
    for (const std::uint32_t row : rows) {
      for (std::size_t d = 0; d < store.dim(); ++d) result.codes.push_back(store.rounded(row, d));
    }
  }
  return result;
}

// At most `prototypes` a landmark over the whole map, and kMaxRows for any one.
Rounded rounded(const PrototypeStore& store, const std::vector<std::uint32_t>& landmarks,
                std::optional<double> prototypes) {
  const double all = static_cast<double>(store.rows());
  const double most =
      prototypes ? std::floor(*prototypes * static_cast<double>(landmarks.size())) : all;
  const bool fits = std::all_of(landmarks.begin(), landmarks.end(), [&](std::uint32_t landmark) {
    return store.rows_of(landmark) <= kMaxRows;
  });
  if (fits && all <= most) return as_they_are(store, landmarks);
  return joined(store, landmarks, Joins(store, landmarks, most));
}

// As PackedPrototypes has them, row i at places[i] of so many...
std::vector<CodeVector> pack8(const Rounded& from, const std::vector<std::uint32_t>& places,
                              std::size_t all_places, std::size_t dim) {
  std::vector<CodeVector> result(packed_size(all_places, dim) / sizeof(CodeVector));
  auto* to = reinterpret_cast<std::int8_t*>(result.data());
  for (std::size_t row = 0; row < from.rows; ++row) {
    for (std::size_t d = 0; d < dim; ++d) {
      to[packed_index(places[row], d, dim)] = from.codes[row * dim + d];
    }
  }
  return result;
}

// ... and as PackedPrototypes4.
std::vector<std::uint8_t> pack4(const Rounded& from, const std::vector<std::uint32_t>& places,
                                std::size_t all_places, std::size_t dim, int half_step) {
  std::vector<std::uint8_t> result(packed4_size(all_places, dim), 0);
  for (std::size_t row = 0; row < from.rows; ++row) {
    for (std::size_t d = 0; d < dim; ++d) {
      const std::uint8_t u = quantize4(from.codes[row * dim + d], half_step);
      std::uint8_t& byte = result[packed4_index(places[row], d, dim)];
      byte |= static_cast<std::uint8_t>(packed4_high(d) ? u << 4 : u);
    }
  }
  return result;
}

// Landmark of each row.
std::vector<std::uint32_t> landmarks_of(const Rounded& rows) {
  std::vector<std::uint32_t> result;
  result.reserve(rows.rows);
  for (std::size_t i = 0; i < rows.rows_of.size(); ++i) {
    result.insert(result.end(), rows.rows_of[i], static_cast<std::uint32_t>(i));
  }
  return result;
}

// How well the cells of a sealed map serve it. `prototypes` numbers landmarks by row; a landmark's
// rows begin at first_rows[landmark].
template <typename Prototypes>
ProbeRanks ranks(const Prototypes& prototypes, const Rounded& rows, const Cells& cells,
                 const std::vector<std::uint32_t>& cell_of_row, int half_step) {
  const std::size_t dim = prototypes.dim;
  const std::vector<std::uint32_t> landmark_of = landmarks_of(rows);
  std::vector<std::int8_t> codes;
  std::vector<std::int64_t> own;
  for (const std::size_t row : test_rows(rows.rows)) {
    codes.insert(codes.end(), &rows.codes[row * dim], &rows.codes[row * dim] + dim);
    own.push_back(landmark_of[row]);
  }
  const Codes queries{codes.data(), own.size(), dim};
  const auto search_two = [&](MatrixView<std::int64_t> ids, MatrixView<float> distances) {
    search(prototypes, queries, {}, ids, distances);
  };
  const auto cell_of = [&](std::int64_t landmark, const std::int8_t* query) {
    const auto begin = std::lower_bound(landmark_of.begin(), landmark_of.end(), landmark);
    std::uint32_t cell = 0;
    std::int32_t least = INT32_MAX;
    for (auto at = begin; at != landmark_of.end() && *at == landmark; ++at) {
      const auto row = static_cast<std::size_t>(at - landmark_of.begin());
      std::int32_t distance = 0;
      for (std::size_t d = 0; d < dim; ++d) {
        const std::int8_t code = rows.codes[row * dim + d];
        const int value = half_step == 0 ? code : level4(quantize4(code, half_step), half_step);
        distance += (query[d] - value) * (query[d] - value);
      }
      if (distance >= least) continue;
      least = distance;
      cell = cell_of_row[row];
    }
    return cell;
  };
  return measure_ranks(queries, own, cells.centroids(), search_two, cell_of);
}

Occurrences occurrences(const std::vector<std::int8_t>& codes) {
  Occurrences result{};
  for (const std::int8_t code : codes) ++result[static_cast<std::uint8_t>(code + 128)];
  return result;
}

}  // namespace

void PrototypeMap::seal(const std::filesystem::path& path, int bits,
                        std::optional<double> prototypes) const {
  if (bits != 8 && bits != 4) {
    throw std::invalid_argument("prototypes are sealed with 8 or 4 bits a number, not " +
                                std::to_string(bits));
  }
  if (prototypes && !(*prototypes >= 1)) {
    throw std::invalid_argument("a map is sealed with at least 1 prototype a landmark, not " +
                                std::to_string(*prototypes));
  }
  const std::shared_lock lock(store_->mutex);
  const auto landmarks = store_->sorted_landmarks();
  const std::size_t n = landmarks.size();
  std::vector<std::int64_t> ids(n);
  std::vector<std::uint8_t> counts(n);
  for (std::size_t i = 0; i < n; ++i) {
    ids[i] = store_->ids()[landmarks[i]];
    counts[i] = static_cast<std::uint8_t>(std::min(store_->observations(landmarks[i]), 255u));
  }
  const Rounded kept = rounded(*store_, landmarks, prototypes);
  const int half_step = bits == 4 ? best_half_step(occurrences(kept.codes)) : 0;
  const Cells& cells = store_->cells();
  const bool indexed = cells.size() != 0;
  const std::vector<std::uint32_t> cell_of_row =
      indexed ? cells.assign({kept.codes.data(), kept.rows, dim_}, 1)
              : std::vector<std::uint32_t>(kept.rows, 0);
  const CellOrder order(cell_of_row, std::max<std::size_t>(cells.size(), 1));
  const std::size_t places = order.first_blocks.back() * kPackedRows;
  std::vector<CodeVector> packed8;
  std::vector<std::uint8_t> packed4;
  if (bits == 4) {
    packed4 = pack4(kept, order.places, places, dim_, half_step);
  } else {
    packed8 = pack8(kept, order.places, places, dim_);
  }
  std::vector<std::uint8_t> landmark_numbers;
  ProbeRanks probe_ranks;
  if (indexed) {
    std::vector<std::uint32_t> landmark_at(places, static_cast<std::uint32_t>(n));
    const std::vector<std::uint32_t> landmark_of = landmarks_of(kept);
    for (std::size_t row = 0; row < kept.rows; ++row) {
      landmark_at[order.places[row]] = landmark_of[row];
    }
    landmark_numbers = pack_bit_numbers(landmark_at, std::bit_width(std::max<std::size_t>(n, 1)));
    RowLandmarks numbers;
    numbers.of_row = landmark_at.data();
    numbers.end = static_cast<std::uint32_t>(n);
    const auto* codes = reinterpret_cast<const std::int8_t*>(packed8.data());
    probe_ranks =
        bits == 4
            ? ranks(PackedPrototypes4{packed4.data(), places, dim_, half_step, nullptr, numbers},
                    kept, cells, cell_of_row, half_step)
            : ranks(PackedPrototypes{codes, places, dim_, nullptr, numbers}, kept, cells,
                    cell_of_row, 0);
  }
  MapShape shape{n, dim_, {}};
  std::vector<std::array<float, 3>> positions;
  const auto& all_positions = store_->positions();
  if (!std::all_of(all_positions.begin(), all_positions.end(), is_nowhere)) {
    shape.origin = middle(all_positions);
    for (const std::uint32_t landmark : landmarks) {
      std::array<float, 3>& relative = positions.emplace_back();
      for (std::size_t i = 0; i < 3; ++i) {
        const double distance = all_positions[landmark][i] - shape.origin[i];
        if (std::abs(distance) > std::numeric_limits<float>::max()) {
          throw std::invalid_argument(
              "positions are too far apart for the 32 bits of a sealed map");
        }
        relative[i] = static_cast<float>(distance);
      }
    }
  }
  const bool implicit_ids = n == 0 || (ids.front() == 0 && ids.back() == std::int64_t(n) - 1);
  const bool several = kept.rows != n;

  ContainerWriter file(FileKind::sealed_map, indexed ? 3 : bits == 4 || several ? 2 : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  if (!implicit_ids) file.add(section::kIds, std::as_bytes(std::span(ids)));
  file.add(section::kCounts, std::as_bytes(std::span(counts)));
  if (several) file.add(section::kRows, std::as_bytes(std::span(kept.rows_of)));
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  file.add(section::kPrototypes,
           bits == 4 ? std::as_bytes(std::span(packed4)) : std::as_bytes(std::span(packed8)));
  if (!positions.empty()) file.add(section::kPositions, std::as_bytes(std::span(positions)));
  if (indexed) {
    file.add(section::kCells, std::as_bytes(std::span(cells.centroids())));
    file.add(section::kCellRows, std::as_bytes(std::span(order.rows)));
    file.add(section::kOrder, std::as_bytes(std::span(landmark_numbers)));
    file.add(section::kProbes, std::as_bytes(std::span(probe_ranks)));
  }
  file.write(path);
}

}  // namespace protomark
