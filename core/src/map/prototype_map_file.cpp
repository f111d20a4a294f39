// Writes and reads the file of a learning map, and its journal.
#include <ranges>

#include "file/ids.h"
#include "map/map_sections.h"
#include "map/map_state.h"

namespace protomark {
namespace {

// In a file, each eight numbers of a sum have as few bits as they need, or up to three more.
constexpr int kSpareBits = 2;

// Bits that a number of a sum of n codes may need: none is beyond 127 n. n is 1 to 255.
int sum_bits(int n) { return 8 + static_cast<int>(std::bit_width(static_cast<unsigned>(n - 1))); }
// Returns how many of these bits none of eight numbers needs.
int spare_bits(const int16_t* eight, int bits) {
  unsigned magnitudes = 0;
  for (size_t i = 0; i < 8; ++i) {
    magnitudes |= static_cast<uint16_t>(eight[i] ^ eight[i] >> 15);
  }
  return std::min(3, bits - 1 - static_cast<int>(std::bit_width(magnitudes)));
}

// Adds sections of all landmarks of a store, or of these by id. It must not change until written.
void add_landmarks(ContainerWriter& file, const PrototypeStore& store,
                   const std::optional<std::vector<LandmarkIndex>>& changed = {}) {
  const size_t dim = store.dim();
  size_t n = 0, m = 0, spares_size = 0, sums_size = 0;
  int64_t largest = -1;
  // A map whose positions were all removed equals one that never had any.
  bool positions = false;
  const auto count = [&](LandmarkIndex landmark) {
    ++n;
    largest = std::max(largest, store.id(landmark));
    positions = positions || has_position(store.position(landmark));
    store.each_row_of(landmark, [&](Row row) {
      ++m;
      const Sum sum = store.sum(row);
      const int width = sum_bits(store.count(row));
      for (size_t d = 0; d < dim; d += 8) {
        spares_size += kSpareBits;
        sums_size += 8 * static_cast<size_t>(width - spare_bits(&sum[d], width));
      }
    });
  };
  if (changed) {
    std::ranges::for_each(*changed, count);
  } else {
    store.each_landmark(count);
  }
  const bool ids = IdBlockWriter::needed(n, largest), several = store.several();
  const auto appearance_bits = static_cast<int>(store.appearance_bits());
  add_value(file, section::kShape, MapShape{n, dim, {}});
  std::vector<ContainerWriter::Part> parts{{section::kCounts, m},
                                           {section::kSpareBits, packed_bytes(spares_size, 1)},
                                           {section::kSums, packed_bytes(sums_size, 1)}};
  if (several) {
    add_value(file, section::kAppearanceBits, static_cast<uint32_t>(appearance_bits));
    parts.push_back({section::kAppearances, packed_bytes(m, appearance_bits + 1)});
  }
  if (positions) parts.push_back({section::kPositions, n * sizeof(Position)});
  if (ids) IdBlockWriter::add_to(parts, n);

  file.add(std::move(parts), [=, &store](ContainerWriter::Writers& to) {
    ValueWriter &counts = to[section::kCounts], &spares = to[section::kSpareBits],
                &sums = to[section::kSums], &appearances = to[section::kAppearances];
    IdBlockWriter ids_of(to);
    const auto put_piece = [&](std::span<const LandmarkIndex> landmarks) {
      constexpr size_t kAhead = 16;
      const std::vector<Row> rows = store.sorted_rows(landmarks);
      for (size_t i = 0; i < rows.size(); ++i) {
        if (i + kAhead < rows.size()) store.prefetch(rows[i + kAhead]);
        counts.add(static_cast<uint8_t>(store.count(rows[i])));
        const Sum sum = store.sum(rows[i]);
        const int width = sum_bits(store.count(rows[i]));
        for (size_t d = 0; d < dim; d += 8) {
          const int spare = spare_bits(&sum[d], width), bits = width - spare;
          spares.add(static_cast<uint64_t>(spare), kSpareBits);
          for (size_t half = d; half < d + 8; half += 4) {
            uint64_t four = 0;
            for (size_t j = half + 4; j-- > half;) {
              four = four << bits | (static_cast<uint64_t>(sum[j]) & ((1u << bits) - 1));
            }
            sums.add(four, 4 * bits);
          }
        }
        if (!several) continue;
        const bool last = i + 1 == rows.size() || store.owner(rows[i + 1]) != store.owner(rows[i]);
        appearances.add(store.appearance(rows[i]) | uint64_t{last} << appearance_bits,
                        appearance_bits + 1);
      }
      for (const LandmarkIndex l : landmarks) {
        if (ids) ids_of.add(store.id(l));
        if (positions) to[section::kPositions].add(store.position(l));
      }
    };
    const auto put = [&](std::span<const LandmarkIndex> landmarks) {
      constexpr size_t kAtOnce = 1 << 10;  // whose rows take little memory
      for (size_t first = 0; first < landmarks.size(); first += kAtOnce) {
        put_piece(landmarks.subspan(first, std::min(kAtOnce, landmarks.size() - first)));
      }
    };
    changed ? put(*changed) : store.visit_sorted_landmarks(put);
    ids_of.finish();
  });
}

// Returns the signs that tell appearances apart; 0 if the file does not state any.
size_t read_appearance_bits(const ContainerReader& file, size_t dim) {
  if (!file.has(section::kAppearanceBits)) return 0;
  const auto bits = read_value<uint32_t>(file, section::kAppearanceBits);
  const size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  file.require(bits >= 1 && bits <= limit, "its appearances have ", bits, " bits, not 1 to ",
               limit);
  return bits;
}

// Checks all landmarks of a file, takes those that no later commit names, and returns their ids.
std::vector<int64_t> read_landmarks(const ContainerReader& file, size_t n, const IdSet& named,
                                    PrototypeStore& store) {
  const size_t dim = store.dim();
  const auto bits = static_cast<int>(store.appearance_bits());
  const bool several = store.several();
  const size_t m = several ? file.map(section::kCounts).size() : n;
  file.require(m <= UINT32_MAX, "it claims more prototypes than a map can hold");
  file.require_size(m >= n, section::kCounts);
  const auto counts = read_section<uint8_t>(file, section::kCounts, m);
  file.require(std::ranges::find(counts, 0) == counts.end(), "it has an impossible prototype");
  const size_t spares_size = m * ((dim + 7) / 8) * kSpareBits;
  PackedReader spares(file, section::kSpareBits, spares_size);
  size_t sums_size = 0;
  for (PackedReader in = spares; const int count : counts) {
    for (size_t d = 0; d < dim; d += 8) {
      sums_size += 8 * (static_cast<size_t>(sum_bits(count)) - in.next(kSpareBits));
    }
  }
  PackedReader sums(file, section::kSums, sums_size);
  std::optional<PackedReader> appearances;
  if (several) {
    appearances.emplace(file, section::kAppearances, m * static_cast<size_t>(bits + 1));
  }
  if (file.has(section::kIdGaps)) file.read(section::kIdGaps);  // checks what is only mapped
  auto ids = LandmarkIds(file, n).all();
  std::vector<Position> positions;
  if (file.has(section::kPositions)) {
    positions = read_section<Position>(file, section::kPositions, n);
  }

  // Not for each of many small commits, which would move all rows each time.
  if (m > store.prototype_count()) {
    store.reserve(store.landmark_count() + n, store.prototype_count() + m);
  }
  std::vector<LandmarkIndex> landmarks;  // if there are positions
  landmarks.reserve(positions.size());
  size_t row = 0;
  for (size_t i = 0; i < n; ++i) {
    const bool is_newest = named.empty() || !named.contains(ids[i]);
    LandmarkIndex landmark = kNoLandmark;
    int32_t before = -1;  // the appearance of the row before
    for (bool last = false; !last; ++row) {
      file.require(row != m, "it has a landmark without prototypes");
      const int count = counts[row];
      Sum sum{};
      bool possible = true;
      for (size_t d = 0; d < dim; d += 8) {
        const int width = sum_bits(count) - static_cast<int>(spares.next(kSpareBits));
        const int sign = 1 << (width - 1);
        for (size_t j = d; j < d + 8; ++j) {
          const int number = (static_cast<int>(sums.next(width)) ^ sign) - sign;
          possible = possible && std::abs(number) <= (j < dim ? 127 * count : 0);
          sum[j] = static_cast<int16_t>(number);
        }
      }
      file.require(possible, "landmark ", ids[i], " has an impossible prototype");
      const auto marked = several ? static_cast<int32_t>(appearances->next(bits + 1)) : 1;
      const int32_t appearance = marked & ((1 << bits) - 1);
      last = marked >> bits != 0;
      file.require(appearance > before, "the appearances of landmark ", ids[i], " do not ascend");
      before = appearance;
      if (!is_newest) continue;
      const Row to = store.create_row(ids[i], landmark, static_cast<uint16_t>(appearance));
      store.set(to, sum, count);
    }
    if (positions.empty()) continue;
    landmarks.push_back(landmark);
    file.require(is_finite(positions[i]) || !has_position(positions[i]), "landmark ", ids[i],
                 " has no finite position");
  }
  file.require(row == m, "it has prototypes of no landmark");
  // After the landmarks, so that room for positions is made once.
  for (size_t i = 0; i < positions.size(); ++i) {
    if (landmarks[i] != kNoLandmark) store.set_position(landmarks[i], positions[i]);
  }
  return ids;
}

std::unique_ptr<MapState> read_with_journal(const std::filesystem::path& path) {
  // Before a journal is made, the file must be a learning map.
  ContainerReader(MappedFile(path).bytes(), path.string()).expect(FileKind::learning_map);
  auto journal = std::make_unique<Journal>(path);
  try {
    const MappedFile mapped(path);
    const ContainerReader file(mapped.bytes(), path.string());
    const auto bytes = journal->read();
    const JournalContent commits(bytes, journal_path(path).string());
    auto state = read_map(file, commits);
    journal->resume(commits, file.identity());
    state->store.uncommitted = std::make_shared<Uncommitted>();
    state->journaled = journal->map();
    state->journal = std::move(journal);
    return state;
  } catch (...) {
    if (journal) journal->abandon();
    throw;
  }
}

// Returns the map as a file, which must be written before the map changes.
ContainerWriter file_of(const MapState& state) {
  ContainerWriter file(FileKind::learning_map);
  file.add(section::kEncoder, state.encoder->serialize());
  add_metadata(file, state.metadata);
  const std::vector<int8_t>& centroids = state.store.quantizer().centroids().data;
  if (!centroids.empty()) file.add(section::kCentroids, std::as_bytes(std::span(centroids)));
  add_landmarks(file, state.store);
  return file;
}

std::vector<std::byte> serialize(ContainerWriter& record, const MapState& state,
                                 const Uncommitted& changes) {
  const auto& changed = changes.landmarks.ids();
  std::vector<int64_t> ids(changed.begin(), changed.end()), removed;
  std::ranges::sort(ids);
  std::vector<LandmarkIndex> existing;
  for (const int64_t id : ids) {
    const LandmarkIndex landmark = state.store.find(id);
    landmark == kNoLandmark ? removed.push_back(id) : existing.push_back(landmark);
  }
  add_landmarks(record, state.store, std::move(existing));
  if (!removed.empty()) record.add(section::kRemoved, std::as_bytes(std::span(removed)));
  if (changes.metadata) {
    // An empty section means that metadata were removed, an absent one that they did not change.
    state.metadata.empty() ? record.add(section::kMetadata, Bytes())
                           : add_metadata(record, state.metadata);
  }
  if (changes.centroids) {
    const std::vector<int8_t>& centroids = state.store.quantizer().centroids().data;
    record.add(section::kCentroids, std::as_bytes(std::span(centroids)));
  }
  return record.serialize();
}

}  // namespace

std::unique_ptr<MapState> read_map(const ContainerReader& file, const JournalContent& journal) {
  file.expect(FileKind::learning_map);
  auto encoder = read_encoder(file);
  const size_t dim = read_shape(file, *encoder).dim, bits = read_appearance_bits(file, dim);
  auto state = std::make_unique<MapState>(std::move(encoder), dim, bits);
  IdSet named;  // by commits that were read
  std::optional<Metadata> metadata;
  std::optional<Matrix<int8_t>> centroids;
  const auto read = [&](const ContainerReader& from) {
    const MapShape shape = read_shape(from, *state->encoder);
    from.require(shape.dim == dim && read_appearance_bits(from, dim) == bits,
                 "its dimension or appearance bits are not the map's");
    const bool is_commit = from.kind() == FileKind::commit;
    auto ids = read_landmarks(from, shape.landmarks, named, state->store);
    if (is_commit && from.has(section::kRemoved)) {
      const auto removed = read_section<int64_t>(from, section::kRemoved);
      check_ids(from, removed);
      ids.insert(ids.end(), removed.begin(), removed.end());
    }
    if (is_commit) std::ranges::for_each(ids, [&](int64_t id) { named.insert(id); });
    if (from.has(section::kCentroids)) {
      // Empty if a commit dropped the index.
      const bool dropped = is_commit && from.map(section::kCentroids).empty();
      auto read_here = dropped ? Matrix<int8_t>() : read_centroids(from, dim);
      if (!centroids) centroids = std::move(read_here);
    }
    if (from.has(section::kMetadata)) {
      auto read_here = read_metadata(from);
      if (!metadata) metadata = std::move(read_here);
    }
  };
  // The newest first, so that an older one counts only for landmarks that no later one names, and
  // nothing has to be removed again.
  for (const auto& [bytes, offset] : journal.commits(file.identity()) | std::views::reverse) {
    read(ContainerReader(bytes, text(journal.name(), ": record at byte ", offset)));
  }
  read(file);
  if (metadata) state->metadata = *std::move(metadata);
  if (centroids && centroids->rows != 0) {
    MapChange(*state).set_quantizer(CoarseQuantizer(*std::move(centroids)), 1, true);
  }
  return state;
}

void PrototypeMap::save(const std::filesystem::path& path) const {
  std::error_code error;
  // Another name of the same file (a hard link) counts as another file.
  if (std::filesystem::canonical(path, error) == state_->journaled && !error) {
    const std::scoped_lock lock(state_->journal_mutex);
    if (state_->journal) return state_->fold();
  }
  const std::shared_lock lock(state_->changing);
  write_guarded(file_of(*state_), path);
}

PrototypeMap PrototypeMap::parse(std::span<const std::byte> bytes, const std::string& name,
                                 std::span<const std::byte> journal) {
  return PrototypeMap(
      read_map(ContainerReader(bytes, name), JournalContent(journal, name + ".journal")));
}

PrototypeMap PrototypeMap::load(const std::filesystem::path& path, bool journal) {
  if (journal) return PrototypeMap(read_with_journal(path));
  const JournaledFile both(path);
  return PrototypeMap(read_map(*both.file, both.journal));
}

bool PrototypeMap::has_journal() const {
  const std::scoped_lock committing(state_->journal_mutex);
  return state_->journal != nullptr;
}

Journal& MapState::need_journal() const {
  require(journal != nullptr, "this map has no journal: open it with a journal to commit");
  return *journal;
}

size_t PrototypeMap::commit() {
  const std::scoped_lock committing(state_->journal_mutex);
  Journal& journal = state_->need_journal();
  ContainerWriter file = journal.record(FileKind::commit);
  std::vector<std::byte> record;
  Uncommitted changes;
  {
    // The record is a copy, so that changes do not wait for the disk.
    const std::shared_lock lock(state_->changing);
    Uncommitted& uncommitted = *state_->store.uncommitted;
    if (uncommitted.empty()) return 0;
    if (!uncommitted.incomplete) {
      record = serialize(file, *state_, uncommitted);
      changes = std::exchange(uncommitted, {});
    }
  }
  if (record.empty()) {
    state_->fold();
    return 0;
  }
  try {
    journal.append(record);
  } catch (...) {
    const std::unique_lock lock(state_->changing);
    state_->store.uncommitted->insert(changes);
    throw;
  }
  return record.size();
}

void PrototypeMap::compact() {
  const std::scoped_lock committing(state_->journal_mutex);
  state_->fold();
}

void MapState::fold() {
  Journal& of_map = need_journal();
  std::string identity;
  {
    const std::shared_lock lock(changing);
    file_of(*this).write(of_map.map(), [&](const std::string& written) {
      of_map.fold(written);
      identity = written;
    });
    *store.uncommitted = {};
  }
  of_map.restart(identity);
}

void PrototypeMap::close() {
  const std::scoped_lock committing(state_->journal_mutex);
  const std::unique_lock lock(state_->changing);
  state_->store.uncommitted.reset();
  state_->journal.reset();
}

}  // namespace protomark
