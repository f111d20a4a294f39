// Maps that become one, and one that becomes several.
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "file/sections.h"
#include "map/prototype_store.h"
#include "protomark/error.h"

namespace protomark {
namespace {

using Cell = std::array<std::int64_t, 3>;

// Beyond this, neighbouring cells are one in double precision.
constexpr double kMaxCell = 9007199254740992;  // 2^53

Cell cell_of(const Position& position, double size) {
  Cell cell;
  for (std::size_t i = 0; i < cell.size(); ++i) {
    // A quotient alone may be rounded up to the next cell; a remainder is exact.
    const double rest = std::fmod(position[i], size);
    const double index = std::round((position[i] - rest) / size) - (rest < 0 ? 1 : 0);
    if (!(std::abs(index) <= kMaxCell)) {
      throw std::invalid_argument("cells of " + std::to_string(size) +
                                  " are too small for the extent of this map");
    }
    cell[i] = static_cast<std::int64_t>(index);
  }
  return cell;
}

}  // namespace

void PrototypeMap::update(const PrototypeMap& other, std::span<const std::int64_t> into,
                          std::span<const std::int64_t> source) {
  if (&other == this) throw std::invalid_argument("a map cannot be joined to itself");
  if (other.encoder_->identity() != encoder_->identity() || other.dim_ != dim_) {
    throw std::invalid_argument("maps of different encoders or dimensions cannot be joined: '" +
                                encoder_->info().name + "' with " + std::to_string(dim_) + ", '" +
                                other.encoder_->info().name + "' with " +
                                std::to_string(other.dim_));
  }
  if (other.look_bits() != look_bits()) {
    throw std::invalid_argument("maps of " + std::to_string(look_bits()) + " and " +
                                std::to_string(other.look_bits()) +
                                " look bits cannot be joined: build both with the same");
  }
  if (into.size() != source.size()) {
    throw std::invalid_argument(std::to_string(into.size()) + " landmark ids for " +
                                std::to_string(source.size()) + " sources");
  }
  // Both wait for their turn, in one order for all pairs of maps, so that no two updates wait for
  // each other.
  std::unique_lock own(store_->changing, std::defer_lock);
  std::shared_lock others(other.store_->changing, std::defer_lock);
  if (std::less<>{}(store_.get(), other.store_.get())) {
    own.lock();
    others.lock();
  } else {
    others.lock();
    own.lock();
  }
  const Store& from = *other.store_;
  std::unordered_map<std::uint32_t, std::int64_t> renamed;
  renamed.reserve(source.size());
  for (std::size_t i = 0; i < source.size(); ++i) {
    if (into[i] < 0) {
      throw std::invalid_argument("landmark id " + std::to_string(into[i]) + " is negative");
    }
    if (!renamed.emplace(from.at(source[i]), into[i]).second) {
      throw std::invalid_argument("landmark " + std::to_string(source[i]) +
                                  " of the other map is named twice");
    }
  }
  Metadata metadata = joined(store_->metadata, from.metadata);
  if (!from.positions().empty()) store_->make_room_for_positions();
  // By id, so that the result does not depend on how the other map came about.
  const std::vector<std::uint32_t> landmarks = from.sorted_landmarks();
  std::vector<std::int64_t> ids;
  for (std::size_t first = 0, last = 0; first < landmarks.size(); first = last) {
    ids.clear();
    std::size_t rows = 0;
    for (; last < landmarks.size() && rows < Store::kPiece; ++last) {
      const auto found = renamed.find(landmarks[last]);
      ids.push_back(found == renamed.end() ? from.ids()[landmarks[last]] : found->second);
      rows += from.rows_of(landmarks[last]);
    }
    const auto piece = std::span(landmarks).subspan(first, last - first);
    const auto unknown = static_cast<std::size_t>(std::count_if(
        ids.begin(), ids.end(), [&](std::int64_t id) { return store_->find(id) == Store::kNone; }));
    store_->make_room(unknown, look_bits() == 0 ? unknown : rows, rows);
    const std::unique_lock lock(store_->mutex);
    for (std::size_t i = 0; i < piece.size(); ++i) {
      for (std::uint32_t row = from.first_row(piece[i]); row != Store::kNone;
           row = from.next_row(row)) {
        store_->join(store_->find_or_create_row(ids[i], from.look(row)), from.sum(row),
                     from.count(row));
      }
      const std::uint32_t landmark = store_->at(ids[i]);
      if (is_nowhere(store_->position(landmark))) {
        store_->set_position(landmark, from.position(piece[i]));
      }
    }
    store_->settle(1);
  }
  const std::unique_lock lock(store_->mutex);
  store_->set_metadata(std::move(metadata));
}

PrototypeMap PrototypeMap::part(std::span<const std::uint32_t> landmarks) const {
  PrototypeMap result(encoder_, dim_, look_bits());
  Store& to = *result.store_;
  to.metadata = store_->metadata;
  std::size_t rows = 0;
  for (const std::uint32_t landmark : landmarks) rows += store_->rows_of(landmark);
  to.reserve(landmarks.size(), rows);
  for (const std::uint32_t landmark : landmarks) {
    const std::uint32_t own = to.create_landmark(store_->ids()[landmark]);
    for (const std::uint32_t row : store_->sorted_rows(landmark)) {
      to.join(to.create_row(own, store_->look(row)), store_->sum(row), store_->count(row));
    }
    to.set_position(own, store_->position(landmark));
  }
  return result;
}

std::vector<PrototypeMap> PrototypeMap::split(std::span<const std::int64_t> boundaries) const {
  if (!std::is_sorted(boundaries.begin(), boundaries.end())) {
    throw std::invalid_argument("boundaries of parts must ascend");
  }
  const std::shared_lock changing(store_->changing);
  const std::vector<std::uint32_t> landmarks = store_->sorted_landmarks();
  std::vector<PrototypeMap> parts;
  parts.reserve(boundaries.size() + 1);
  auto first = landmarks.begin();
  for (std::size_t i = 0; i <= boundaries.size(); ++i) {
    const auto last = i == boundaries.size()
                          ? landmarks.end()
                          : std::lower_bound(first, landmarks.end(), boundaries[i],
                                             [&](std::uint32_t landmark, std::int64_t id) {
                                               return store_->ids()[landmark] < id;
                                             });
    parts.push_back(part({first, last}));
    first = last;
  }
  return parts;
}

std::vector<MapPart> PrototypeMap::split(double cell_size) const {
  if (!(cell_size > 0) || std::isinf(cell_size)) {
    throw std::invalid_argument("the edge of a cell must be above 0 and finite");
  }
  const std::shared_lock changing(store_->changing);
  std::vector<std::uint32_t> landmarks = store_->sorted_landmarks();
  const auto nowhere = std::stable_partition(
      landmarks.begin(), landmarks.end(),
      [&](std::uint32_t landmark) { return !is_nowhere(store_->position(landmark)); });
  std::vector<std::pair<Cell, std::uint32_t>> placed;
  placed.reserve(static_cast<std::size_t>(nowhere - landmarks.begin()));
  for (auto it = landmarks.begin(); it != nowhere; ++it) {
    placed.emplace_back(cell_of(store_->position(*it), cell_size), *it);
  }
  std::stable_sort(placed.begin(), placed.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });
  std::transform(placed.begin(), placed.end(), landmarks.begin(),
                 [](const auto& one) { return one.second; });

  std::vector<MapPart> parts;
  const std::span<const std::uint32_t> all(landmarks);
  for (std::size_t first = 0, last = 0; first < placed.size(); first = last) {
    while (last < placed.size() && placed[last].first == placed[first].first) ++last;
    parts.push_back({placed[first].first, part(all.subspan(first, last - first))});
  }
  if (placed.size() < all.size()) {
    parts.push_back({std::nullopt, part(all.subspan(placed.size()))});
  }
  return parts;
}

}  // namespace protomark
