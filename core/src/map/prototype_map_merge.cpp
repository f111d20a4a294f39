// Merges maps into one, and splits one into parts.
#include <unordered_map>

#include "map/map_sections.h"
#include "map/map_state.h"

namespace protomark {
namespace {

using Cell = std::array<int64_t, 3>;

// Beyond this, neighbouring cells are the same in double precision.
constexpr double kMaxCell = 9007199254740992;  // 2^53

Cell cell_of(const Position& position, double size) {
  Cell cell;
  for (size_t i = 0; i < cell.size(); ++i) {
    // A quotient alone may be rounded up to the next cell; a remainder is exact.
    const double remainder = std::fmod(position[i], size);
    const double index = std::round((position[i] - remainder) / size) - (remainder < 0 ? 1 : 0);
    if (!(std::abs(index) <= kMaxCell)) {
      invalid("cells of ", size, " are too small for the extent of this map");
    }
    cell[i] = static_cast<int64_t>(index);
  }
  return cell;
}

void check_alike(const PrototypeMap& map, const PrototypeMap& other) {
  const auto describe = [](const PrototypeMap& m) {
    return text("'", m.encoder()->info().name, "' with ", m.dim());
  };
  if (other.encoder()->identity() != map.encoder()->identity() || other.dim() != map.dim()) {
    invalid("maps of different encoders or dimensions cannot be merged: ", describe(map), ", ",
            describe(other));
  }
  if (other.appearance_bits() != map.appearance_bits()) {
    invalid("maps of ", map.appearance_bits(), " and ", other.appearance_bits(),
            " appearance bits cannot be merged: build both with the same");
  }
}

}  // namespace

void PrototypeMap::merge_map(const PrototypeMap& other, std::span<const int64_t> into,
                             std::span<const int64_t> source) {
  if (&other == this) invalid("a map cannot be merged into itself");
  check_alike(*this, other);
  check_pairs(into.size(), source.size(), "sources");
  // In one order for all pairs of maps, so that no two merges wait for each other.
  std::unique_lock changing(state_->changing, std::defer_lock);
  std::shared_lock reading(other.state_->changing, std::defer_lock);
  const bool first_this = std::less<>{}(state_.get(), other.state_.get());
  if (first_this) changing.lock();
  reading.lock();
  if (!first_this) changing.lock();
  MapChange change(*state_, std::move(changing));
  PrototypeStore& to = state_->store;
  const PrototypeStore& from = other.state_->store;
  std::unordered_map<uint32_t, int64_t> renamed;
  renamed.reserve(source.size());
  for (size_t i = 0; i < source.size(); ++i) {
    const int64_t id = into[i], other_id = source[i];
    if (id < 0) invalid("landmark id ", id, " is negative");
    if (!renamed.emplace(from.at(other_id).value, id).second) {
      invalid("landmark ", other_id, " of the other map is named twice");
    }
  }
  Metadata metadata = merged(state_->metadata, other.state_->metadata);
  if (!from.positions().empty()) to.make_room_for_positions(state_->searching);
  // By id, so that the result does not depend on the history of the other map.
  const std::vector<LandmarkIndex> landmarks = from.sorted_landmarks();
  std::vector<int64_t> ids;
  for (size_t first = 0, end = 0; first < landmarks.size(); first = end) {
    ids.clear();
    size_t rows = 0, new_landmarks = 0;
    for (; end < landmarks.size() && rows < MapChange::kPiece; ++end) {
      const auto found = renamed.find(landmarks[end].value);
      ids.push_back(found == renamed.end() ? from.id(landmarks[end]) : found->second);
      rows += from.row_count(landmarks[end]);
      if (to.find(ids.back()) == kNoLandmark) ++new_landmarks;
    }
    to.make_room(new_landmarks, to.several() ? rows : new_landmarks, rows, state_->searching);
    const auto lock = change.write();
    for (size_t i = 0; i < ids.size(); ++i) to.merge(ids[i], from, landmarks[first + i]);
    to.reassign(1);
  }
  change.set_metadata(std::move(metadata));
}

PrototypeMap MapState::part(std::span<const LandmarkIndex> landmarks) const {
  auto result = std::make_unique<MapState>(encoder, store.dim(), store.appearance_bits());
  PrototypeStore& to = result->store;
  result->metadata = metadata;
  size_t rows = 0;
  for (const LandmarkIndex landmark : landmarks) rows += store.row_count(landmark);
  to.reserve(landmarks.size(), rows);
  for (const LandmarkIndex landmark : landmarks) to.merge(store.id(landmark), store, landmark);
  return PrototypeMap(std::move(result));
}

PrototypeMap PrototypeMap::part(std::span<const int64_t> ids) const {
  const std::shared_lock lock(state_->changing);
  std::vector<LandmarkIndex> landmarks;
  landmarks.reserve(ids.size());
  for (const int64_t id : ids) landmarks.push_back(state_->store.at(id));
  sort_unique(landmarks);
  return state_->part(landmarks);
}

std::vector<PrototypeMap> PrototypeMap::split_by_id(std::span<const int64_t> boundaries) const {
  if (!std::ranges::is_sorted(boundaries)) invalid("boundaries of parts must ascend");
  const std::shared_lock lock(state_->changing);
  const std::vector<LandmarkIndex> landmarks = state_->store.sorted_landmarks();
  std::vector<PrototypeMap> parts;
  parts.reserve(boundaries.size() + 1);
  auto first = landmarks.begin();
  for (size_t i = 0; i <= boundaries.size(); ++i) {
    const auto end =
        i == boundaries.size()
            ? landmarks.end()
            : std::ranges::lower_bound(first, landmarks.end(), boundaries[i], {},
                                       [&](LandmarkIndex l) { return state_->store.id(l); });
    parts.push_back(state_->part({first, end}));
    first = end;
  }
  return parts;
}

std::vector<MapPart> PrototypeMap::split_by_space(double cell_size) const {
  if (!(cell_size > 0) || std::isinf(cell_size)) {
    invalid("the edge of a cell must be above 0 and finite");
  }
  const std::shared_lock lock(state_->changing);
  const PrototypeStore& store = state_->store;
  std::vector<std::pair<std::optional<Cell>, LandmarkIndex>> all;
  all.reserve(store.landmark_count());
  for (const LandmarkIndex landmark : store.sorted_landmarks()) {
    const Position position = store.position(landmark);
    all.emplace_back(std::nullopt, landmark);
    if (has_position(position)) all.back().first = cell_of(position, cell_size);
  }
  // By cell, then those without a position.
  std::ranges::stable_sort(all, [](const auto& a, const auto& b) {
    return a.first && (!b.first || *a.first < *b.first);
  });
  std::vector<MapPart> parts;
  std::vector<LandmarkIndex> landmarks;
  for (size_t i = 0; i < all.size(); ++i) {
    landmarks.push_back(all[i].second);
    if (i + 1 < all.size() && all[i + 1].first == all[i].first) continue;
    parts.push_back({all[i].first, state_->part(landmarks)});
    landmarks.clear();
  }
  return parts;
}

}  // namespace protomark
