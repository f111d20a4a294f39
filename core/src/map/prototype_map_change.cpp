// Changes observations, landmarks, positions and metadata of a learning map.
#include <unordered_map>

#include "base/parallel.h"
#include "map/map_state.h"

namespace protomark {
namespace {

// Descriptors that are encoded at a time, so that their codes take little memory.
constexpr size_t kEncodeChunk = 1 << 13;
// Descriptors that a thread encodes at a time while another one adds.
constexpr size_t kMinShare = 64, kMaxShare = 512;

void check_new_id(int64_t id) {
  if (id < 0) invalid("landmark id ", id, " is negative");
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
  // Also without descriptors, to check their length.
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
    int64_t id;
    uint16_t appearance;
    int count;
    std::vector<int> sum;
  };
  std::vector<Difference> differences;
  std::unordered_map<uint32_t, size_t> of_row;
  const auto never_added = [](int64_t id) {
    invalid("descriptors to subtract from landmark ", id, " were never added to it");
  };
  for (size_t i = 0; i < ids.size(); ++i) {
    const int64_t id = ids[i];
    const Row row = store.find_row(store.at(id), store.appearance_of(codes.row(i)));
    if (row == kNoRow) never_added(id);
    const auto [found, is_new] = of_row.emplace(row.value, differences.size());
    if (is_new) differences.push_back({id, store.appearance(row), 0, std::vector<int>(dim)});
    Difference& difference = differences[found->second];
    for (size_t d = 0; d < dim; ++d) difference.sum[d] += codes.row(i)[d];
    ++difference.count;
  }
  for (const auto& [row_value, index] : of_row) {
    const Row row{row_value};
    const Difference& difference = differences[index];
    const int left = store.count(row) - difference.count;
    if (left < 0) {
      invalid("landmark ", difference.id, " has ", store.count(row), " observations",
              store.several() ? " of one appearance" : "", ", ", difference.count,
              " cannot be subtracted");
    }
    const Sum sum = store.sum(row);
    for (size_t d = 0; d < dim; ++d) {
      if (std::abs(sum[d] - difference.sum[d]) > 127 * left) never_added(difference.id);
    }
  }
  change.in_pieces(differences.size(), [&](size_t i) {
    const Difference& difference = differences[i];
    const Row row = store.find_row(difference.id, difference.appearance);
    if (store.count(row) == difference.count) return store.erase_row(row);
    Sum sum = store.sum(row);
    for (size_t d = 0; d < dim; ++d) {
      sum[d] = static_cast<int16_t>(sum[d] - difference.sum[d]);
    }
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
      if (removed.contains(id)) {
        invalid("landmark ", id, " was merged into another earlier in the same call");
      }
    }
    if (to == from) invalid("landmark ", to, " cannot be merged into itself");
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
    if (!is_finite(p) && has_position(p))
      invalid("position of landmark ", ids[i], " is not finite");
  }
  if (std::ranges::any_of(positions, has_position)) {
    store.make_room_for_positions(state_->searching);
  }
  change.in_pieces(ids.size(),
                   [&](size_t i) { store.set_position(store.at(ids[i]), positions[i]); });
}

}  // namespace protomark
