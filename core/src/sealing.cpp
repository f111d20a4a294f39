// PrototypeMap::seal: what a map knows, in as few bytes as were asked for.
#include <algorithm>
#include <cmath>
#include <functional>
#include <mutex>
#include <queue>
#include <stdexcept>
#include <string>
#include <utility>

#include "container.h"
#include "map_sections.h"
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

// As PackedPrototypes has them ...
std::vector<std::uint8_t> pack8(const Rounded& from, std::size_t dim) {
  std::vector<std::uint8_t> result(packed_size(from.rows, dim), 0);
  for (std::size_t row = 0; row < from.rows; ++row) {
    for (std::size_t d = 0; d < dim; ++d) {
      result[packed_index(row, d, dim)] = static_cast<std::uint8_t>(from.codes[row * dim + d]);
    }
  }
  return result;
}

// ... and as PackedPrototypes4.
std::vector<std::uint8_t> pack4(const Rounded& from, std::size_t dim, int half_step) {
  std::vector<std::uint8_t> result(packed4_size(from.rows, dim), 0);
  for (std::size_t row = 0; row < from.rows; ++row) {
    for (std::size_t d = 0; d < dim; ++d) {
      const std::uint8_t u = quantize4(from.codes[row * dim + d], half_step);
      result[packed4_index(row, d, dim)] |= static_cast<std::uint8_t>(packed4_high(d) ? u << 4 : u);
    }
  }
  return result;
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
  const std::vector<std::uint8_t> packed =
      bits == 4 ? pack4(kept, dim_, half_step) : pack8(kept, dim_);
  MapShape shape{n, dim_, {}};
  std::vector<std::array<float, 3>> positions;
  const auto& all_positions = store_->positions();
  if (!std::all_of(all_positions.begin(), all_positions.end(), is_nowhere)) {
    shape.origin = middle(all_positions);
    for (const std::uint32_t landmark : landmarks) {
      const Position& p = all_positions[landmark];
      positions.push_back({static_cast<float>(p[0] - shape.origin[0]),
                           static_cast<float>(p[1] - shape.origin[1]),
                           static_cast<float>(p[2] - shape.origin[2])});
    }
  }
  const bool implicit_ids = n == 0 || (ids.front() == 0 && ids.back() == std::int64_t(n) - 1);
  const bool several = kept.rows != n;

  ContainerWriter file(FileKind::sealed_map, bits == 4 || several ? 2 : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  if (!implicit_ids) file.add(section::kIds, std::as_bytes(std::span(ids)));
  file.add(section::kCounts, std::as_bytes(std::span(counts)));
  if (several) file.add(section::kRows, std::as_bytes(std::span(kept.rows_of)));
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  file.add(section::kPrototypes, std::as_bytes(std::span(packed)));
  if (!positions.empty()) file.add(section::kPositions, std::as_bytes(std::span(positions)));
  file.write(path);
}

}  // namespace protomark
