// Changes of a learning map; merges maps into one and splits one into parts.
#include <map>
#include <unordered_map>

#include "base/parallel.h"
#include "map/map_sections.h"
#include "map/map_state.h"

namespace protomark {
namespace {

// Descriptors that are encoded at a time, so that their codes take little memory.
constexpr size_t kEncodeChunk = 1 << 13;
// Descriptors that a thread encodes at a time while another one adds.
constexpr size_t kMinShare = 64, kMaxShare = 512;

void check_new_id(int64_t id) { require(id >= 0, "landmark id ", id, " is negative"); }

using Cell = std::array<int64_t, 3>;

// Beyond this, neighbouring cells are the same in double precision.
constexpr double kMaxCell = 9007199254740992;  // 2^53

Cell cell_of(const Position& position, double size) {
  Cell cell;
  for (size_t i = 0; i < cell.size(); ++i) {
    // A quotient alone may be rounded up to the next cell; a remainder is exact.
    const double remainder = std::fmod(position[i], size);
    const double index = std::round((position[i] - remainder) / size) - (remainder < 0 ? 1 : 0);
    require(std::abs(index) <= kMaxCell, "cells of ", size,
            " are too small for the extent of this map");
    cell[i] = static_cast<int64_t>(index);
  }
  return cell;
}

void check_alike(const PrototypeMap& map, const PrototypeMap& other) {
  require(other.encoder()->identity() == map.encoder()->identity() && other.dim() == map.dim(),
          "maps of different encoders or dimensions cannot be merged: '",
          map.encoder()->info().name, "' with ", map.dim(), ", '", other.encoder()->info().name,
          "' with ", other.dim());
  require(other.appearance_bits() == map.appearance_bits(), "maps of ", map.appearance_bits(),
          " and ", other.appearance_bits(),
          " appearance bits cannot be merged: build both with the same");
}

}  // namespace

void MapChange::add(std::span<const int64_t> ids, Codes codes, int threads) {
  PrototypeStore& store = state_->store;
  std::vector<PrototypeStore::Key> keys;
  std::vector<Row> rows;
  for (size_t begin = 0; begin < codes.rows; begin += kPiece) {
    const size_t n = std::min(kPiece, codes.rows - begin);
    const Codes piece{codes.row(begin), n, codes.columns};
    // Copies of ids, checked once more, as a caller may write over them meanwhile.
    keys.clear();
    for (size_t i = 0; i < n; ++i) {
      keys.push_back({ids[begin + i], store.appearance_of(piece.row(i))});
      check_new_id(keys[i].id);
    }
    rows.resize(n);
    store.find_rows(keys, rows);
    size_t new_landmarks = 0, new_rows = 0;
    for (size_t i = 0; i < n; ++i) {
      if (rows[i] != kNoRow) continue;
      ++new_rows;
      if (store.find(keys[i].id) == kNoLandmark) ++new_landmarks;
    }
    store.make_room(new_landmarks, new_rows, n, state_->searching);
    const auto lock = write();
    store.add(keys, piece, rows);
    store.reassign(threads);
  }
}

void MapChange::set_metadata(Metadata metadata) {
  const auto lock = write();
  if (state_->store.uncommitted) {
    state_->store.uncommitted->metadata |= metadata != state_->metadata;
  }
  state_->metadata = std::move(metadata);
}

void PrototypeMap::add(std::span<const int64_t> ids, Descriptors descriptors, int threads) {
  check_pairs(ids.size(), descriptors.rows, "descriptors");
  std::ranges::for_each(ids, check_new_id);
  const size_t dim = this->dim();
  // One chunk is encoded while the chunk before it is added.
  std::vector<int8_t> buffer(std::min(descriptors.rows, 2 * kEncodeChunk) * dim);
  const auto codes = [&](size_t begin) {
    return MatrixView<int8_t>{buffer.data() + begin / kEncodeChunk % 2 * kEncodeChunk * dim,
                              std::min(kEncodeChunk, descriptors.rows - begin), dim};
  };
  const auto encode = [&](size_t begin, MatrixView<int8_t> to, int encode_threads) {
    encoder()->encode({descriptors.row(begin), to.rows, descriptors.columns}, to, encode_threads);
  };
  MapChange change(*state_);
  const auto add_chunk = [&](size_t begin) {
    const auto chunk = codes(begin);
    change.add(ids.subspan(begin, chunk.rows), chunk, threads);
  };
  encoder()->check(descriptors, threads);  // all of them, before the first is added
  encode(0, codes(0), threads);
  size_t begin = 0;
  for (size_t next = kEncodeChunk; next < descriptors.rows; next += kEncodeChunk) {
    const auto chunk = codes(next);
    if (state_->store.quantizer().nlist() == 0) {
      // One thread adds encoded observations, mostly waiting for memory, while the others encode.
      const size_t share =
          std::clamp<size_t>(chunk.rows / (4 * static_cast<size_t>(threads)), kMinShare, kMaxShare);
      run_tasks(threads, 1 + (chunk.rows + share - 1) / share, [&](size_t task) {
        if (task == 0) return add_chunk(begin);
        const size_t first = (task - 1) * share, n = std::min(share, chunk.rows - first);
        encode(next + first, {chunk.row(first), n, dim}, 1);
      });
    } else {
      // All threads share the work on inverted lists.
      add_chunk(begin);
      encode(next, chunk, threads);
    }
    begin = next;
  }
  add_chunk(begin);
}

void PrototypeMap::add_codes(std::span<const int64_t> ids, Codes codes) {
  check_pairs(ids.size(), codes.rows, "codes");
  check_codes(codes, dim());
  std::ranges::for_each(ids, check_new_id);
  MapChange(*state_).add(ids, codes, 1);
}

void PrototypeMap::subtract(std::span<const int64_t> ids, Descriptors descriptors, int threads) {
  check_pairs(ids.size(), descriptors.rows, "descriptors");
  subtract_codes(ids, encoder()->encode(descriptors, dim(), threads));
}

void PrototypeMap::subtract_codes(std::span<const int64_t> ids, Codes codes) {
  check_pairs(ids.size(), codes.rows, "codes");
  check_codes(codes, dim());
  const size_t dim = codes.columns;
  MapChange change(*state_);
  PrototypeStore& store = state_->store;

  // Sums up what to subtract from each row, to check everything before anything changes.
  struct Difference {
    std::vector<int> sum;
    int count = 0;
  };
  std::map<PrototypeStore::Key, Difference> differences;
  for (size_t i = 0; i < ids.size(); ++i) {
    const PrototypeStore::Key key{ids[i], store.appearance_of(codes.row(i))};
    Difference& difference = differences[key];
    difference.sum.resize(dim);
    for (size_t d = 0; d < dim; ++d) difference.sum[d] += codes.row(i)[d];
    ++difference.count;
  }
  for (const auto& [key, difference] : differences) {
    const Row row = store.find_row(store.at(key.id), key.appearance);
    const int left = row == kNoRow ? 0 : store.count(row) - difference.count;
    require(left >= 0, "landmark ", key.id, " has ", left + difference.count, " observations",
            store.several() ? " of one appearance" : "", ", ", difference.count,
            " cannot be subtracted");
    bool possible = row != kNoRow;
    const Sum sum = possible ? store.sum(row) : Sum{};
    for (size_t d = 0; d < dim; ++d) {
      possible = possible && std::abs(sum[d] - difference.sum[d]) <= 127 * left;
    }
    require(possible, "descriptors to subtract from landmark ", key.id, " were never added to it");
  }
  auto next = differences.begin();
  change.in_pieces(differences.size(), [&](size_t) {
    const auto& [key, difference] = *next++;
    const Row row = store.find_row(key.id, key.appearance);
    if (store.count(row) == difference.count) return store.erase_row(row);
    Sum sum = store.sum(row);
    for (size_t d = 0; d < dim; ++d) sum[d] = static_cast<int16_t>(sum[d] - difference.sum[d]);
    store.set(row, sum, store.count(row) - difference.count);
  });
}

void PrototypeMap::remove(std::span<const int64_t> ids) {
  MapChange change(*state_);
  std::vector<int64_t> sorted(ids.begin(), ids.end());
  sort_unique(sorted);
  for (const int64_t id : sorted) state_->store.at(id);
  change.in_pieces(sorted.size(), [&](size_t i) { state_->store.erase(sorted[i]); });
}

void PrototypeMap::merge_landmarks(std::span<const int64_t> into, std::span<const int64_t> source) {
  check_pairs(into.size(), source.size(), "sources");
  MapChange change(*state_);
  PrototypeStore& store = state_->store;
  IdSet removed;
  // A copy, as a caller may write over ids meanwhile.
  std::vector<std::array<int64_t, 2>> pairs;
  for (size_t i = 0; i < into.size(); ++i) {
    const auto [to, from] = pairs.emplace_back(std::array{into[i], source[i]});
    for (const int64_t id : {to, from}) {
      store.at(id);
      require(!removed.contains(id), "landmark ", id,
              " was merged into another earlier in the same call");
    }
    require(to != from, "landmark ", to, " cannot be merged into itself");
    removed.insert(from);
  }
  change.in_pieces(pairs.size(), [&](size_t i) {
    const auto [to, from] = pairs[i];
    store.merge(to, store, store.at(from));
    store.erase(from);
  });
}

void PrototypeMap::set_metadata(Metadata metadata) {
  check_metadata(metadata);
  MapChange(*state_).set_metadata(std::move(metadata));
}

void PrototypeMap::set_positions(std::span<const int64_t> ids,
                                 std::span<const Position> positions) {
  check_pairs(ids.size(), positions.size(), "positions");
  MapChange change(*state_);
  PrototypeStore& store = state_->store;
  for (size_t i = 0; i < ids.size(); ++i) {
    store.at(ids[i]);
    const Position& p = positions[i];
    require(is_finite(p) || !has_position(p), "position of landmark ", ids[i], " is not finite");
  }
  if (std::ranges::any_of(positions, has_position)) {
    store.make_room_for_positions(state_->searching);
  }
  change.in_pieces(ids.size(),
                   [&](size_t i) { store.set_position(store.at(ids[i]), positions[i]); });
}

void PrototypeMap::merge_map(const PrototypeMap& other, std::span<const int64_t> into,
                             std::span<const int64_t> source) {
  require(&other != this, "a map cannot be merged into itself");
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
    check_new_id(id);
    const bool is_new = renamed.emplace(from.at(other_id).value, id).second;
    require(is_new, "landmark ", other_id, " of the other map is named twice");
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
  require(std::ranges::is_sorted(boundaries), "boundaries of parts must ascend");
  const std::shared_lock lock(state_->changing);
  const std::vector<LandmarkIndex> landmarks = state_->store.sorted_landmarks();
  std::vector<PrototypeMap> parts;
  parts.reserve(boundaries.size() + 1);
  std::span<const LandmarkIndex> rest = landmarks;
  for (const int64_t boundary : boundaries) {
    const auto end = std::ranges::lower_bound(rest, boundary, {},
                                              [&](LandmarkIndex l) { return state_->store.id(l); });
    parts.push_back(state_->part({rest.begin(), end}));
    rest = {end, rest.end()};
  }
  parts.push_back(state_->part(rest));
  return parts;
}

std::vector<MapPart> PrototypeMap::split_by_space(double cell_size) const {
  require(cell_size > 0 && !std::isinf(cell_size), "the edge of a cell must be above 0 and finite");
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
