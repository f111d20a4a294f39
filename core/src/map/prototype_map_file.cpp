// Writes and reads the file of a learning map, and its journal.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "file/sections.h"
#include "map/map_sections.h"
#include "map/map_state.h"
#include "map/packed_sums.h"

namespace protomark {
namespace {

// Bytes of an appearance in a file.
std::size_t appearance_size(const PrototypeStore& store) {
  return store.appearance_bits() <= 8 ? 1 : 2;
}

// Hands the packed sums of rows to a sink.
void put_sums(const ContainerWriter::Sink& sink, const PrototypeStore& store,
              std::span<const Row> rows) {
  constexpr std::size_t kAhead = 16;
  constexpr std::size_t kPiece = 1 << 16;  // bytes, and those of one row
  std::vector<std::byte> packed;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const Row row = rows[i];
    if (i + kAhead < rows.size()) store.prefetch(rows[i + kAhead]);
    const auto sum = pack_sum(store.sum(row), store.count(row), store.dim());
    packed.insert(packed.end(), sum.begin(),
                  sum.begin() + packed_sum_size(store.count(row), store.dim()));
    if (packed.size() < kPiece && i + 1 < rows.size()) continue;
    sink(packed);
    packed.clear();
  }
}

// Adds the sections of all landmarks of a store, or of these in ascending order of ids. The store
// must not change until the file is written.
void add_landmarks(ContainerWriter& file, const PrototypeStore& store,
                   const std::optional<std::vector<LandmarkIndex>>& changed = {}) {
  std::size_t n = 0, m = 0, sum_bytes = 0;
  // A map whose positions were all removed equals one that never had any.
  bool positions = false;
  const auto count = [&](LandmarkIndex landmark) {
    ++n;
    for (Row row = store.first_row(landmark); row != kNoRow; row = store.next_row(row), ++m) {
      sum_bytes += packed_sum_size(store.count(row), store.dim());
    }
    positions = positions || has_position(store.position(landmark));
  };
  if (changed) {
    std::ranges::for_each(*changed, count);
  } else {
    store.each_landmark(count);
  }
  add_value(file, section::kShape, MapShape{n, store.dim(), {}});
  std::vector<ContainerWriter::Part> parts{{section::kIds, n * sizeof(std::int64_t)}};
  if (store.several()) {
    add_value(file, section::kAppearanceBits, static_cast<std::uint32_t>(store.appearance_bits()));
    parts.push_back({section::kRows, n * sizeof(std::uint32_t)});
    parts.push_back({section::kAppearances, m * appearance_size(store)});
  }
  parts.push_back({section::kCounts, m});
  parts.push_back({section::kSums, sum_bytes});
  if (positions) parts.push_back({section::kPositions, n * sizeof(Position)});

  const auto put_piece = [&store, positions](std::span<const ContainerWriter::Sink> sinks,
                                             std::span<const LandmarkIndex> landmarks) {
    const std::vector<Row> sorted = store.sorted_rows(landmarks);
    const std::span<const Row> rows(sorted);
    auto sink = sinks.begin();
    put_each<std::int64_t>(*sink++, landmarks, [&](LandmarkIndex l) { return store.id(l); });
    if (store.several()) {
      put_each<std::uint32_t>(*sink++, landmarks, [&](LandmarkIndex l) {
        return static_cast<std::uint32_t>(store.row_count(l));
      });
      const std::size_t size = appearance_size(store);
      put_values<std::uint8_t>(*sink++, rows.size(), size, [&](std::size_t i, std::uint8_t* to) {
        const std::uint16_t appearance = store.appearance(rows[i]);
        std::memcpy(to, &appearance, size);
      });
    }
    put_each<std::uint8_t>(*sink++, rows,
                           [&](Row row) { return static_cast<std::uint8_t>(store.count(row)); });
    put_sums(*sink++, store, rows);
    if (!positions) return;
    put_each<Position>(*sink, landmarks, [&](LandmarkIndex l) { return store.position(l); });
  };
  file.add_together(std::move(parts), [&store, changed, put_piece](auto sinks) {
    const auto put = [&](std::span<const LandmarkIndex> landmarks) {
      constexpr std::size_t kRows = 1 << 13;  // at a time, and the rest of a landmark
      for (std::size_t first = 0, end = 0; first < landmarks.size(); first = end) {
        for (std::size_t rows = 0; end < landmarks.size() && rows < kRows; ++end) {
          rows += store.row_count(landmarks[end]);
        }
        put_piece(sinks, landmarks.subspan(first, end - first));
      }
    };
    changed ? put(*changed) : store.visit_sorted_landmarks(put);
  });
}

// Returns the signs that tell appearances apart; 0 if the file does not state any.
std::size_t read_appearance_bits(const ContainerReader& file, std::size_t dim) {
  if (!file.has(section::kAppearanceBits)) return 0;
  const auto bits = read_value<std::uint32_t>(file, section::kAppearanceBits);
  const std::size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  if (bits == 0 || bits > limit) {
    file.fail("its appearances have ", bits, " bits, not 1 to ", limit);
  }
  return bits;
}

// Reads the map file and its commits into an empty map, the newest first, so that an older one
// counts only for landmarks that no later one names, and nothing has to be removed again. The time
// is proportional to the bytes read.
class Reading {
 public:
  explicit Reading(MapState& state)
      : encoder_(*state.encoder), store_(state.store), state_(state) {}

  void read_commit(const ContainerReader& commit) {
    const MapShape shape = read_shape(commit, encoder_);
    if (shape.dim != store_.dim() ||
        read_appearance_bits(commit, shape.dim) != store_.appearance_bits()) {
      commit.fail("its dimension or appearance bits are not the map's");
    }
    read_landmarks(commit, shape.landmarks);
    for (const char* name : {section::kIds, section::kRemoved}) {
      if (!commit.has(name)) continue;
      const auto ids =
          read_section<std::int64_t>(commit, name, commit.map(name).size() / sizeof(std::int64_t));
      check_ids(commit, ids);
      for (const std::int64_t id : ids) read_.insert(id);
    }
    if (commit.has(section::kCentroids)) {
      // Empty if the index was dropped.
      auto centroids = commit.map(section::kCentroids).empty() ? std::vector<std::int8_t>()
                                                               : read_centroids(commit, shape.dim);
      if (!centroids_) centroids_ = std::move(centroids);
    }
    if (commit.has(section::kMetadata)) {
      auto metadata = read_metadata(commit);
      if (!metadata_) metadata_ = std::move(metadata);
    }
  }

  void read_map(const ContainerReader& file) {
    auto metadata = read_metadata(file);
    auto centroids = read_centroids(file, store_.dim());
    read_landmarks(file, read_shape(file, encoder_).landmarks);
    state_.metadata = std::move(metadata_ ? *metadata_ : metadata);
    if (centroids_) centroids = std::move(*centroids_);
    if (centroids.empty()) return;
    MapChange(state_).set_quantizer({std::move(centroids), store_.dim()}, 1, true);
  }

 private:
  // Checks all landmarks of a file, and takes those that no later commit names.
  void read_landmarks(const ContainerReader& file, std::size_t n) {
    const std::size_t dim = store_.dim();
    const bool several = store_.several();
    const auto ids = read_section<std::int64_t>(file, section::kIds, n);
    check_ids(file, ids);
    std::vector<std::uint32_t> row_counts;
    std::vector<std::uint16_t> appearances;
    std::size_t m = n;
    if (several) {
      row_counts = read_section<std::uint32_t>(file, section::kRows, n);
      m = sum_rows(file, std::span<const std::uint32_t>(row_counts));
      const std::size_t size = appearance_size(store_);
      const auto bytes = read_section<std::uint8_t>(file, section::kAppearances, m * size);
      appearances.resize(m);
      for (std::size_t i = 0; i < m; ++i) std::memcpy(&appearances[i], &bytes[i * size], size);
    }
    const auto counts = read_section<std::uint8_t>(file, section::kCounts, m);
    if (std::ranges::find(counts, 0) != counts.end()) file.fail("it has an impossible prototype");
    Bytes sums = file.read(section::kSums);
    const std::size_t sum_bytes = std::accumulate(
        counts.begin(), counts.end(), std::size_t{0},
        [&](std::size_t size, int count) { return size + packed_sum_size(count, dim); });
    if (sums.size() != sum_bytes) file.fail_size(section::kSums);
    std::vector<Position> positions;
    if (file.has(section::kPositions)) {
      positions = read_section<Position>(file, section::kPositions, n);
    }

    // Not for each of many small commits, which would move all rows each time.
    if (m > store_.prototype_count()) {
      store_.reserve(store_.landmark_count() + n, store_.prototype_count() + m);
    }
    std::vector<LandmarkIndex> landmarks;  // if there are positions
    landmarks.reserve(positions.size());
    for (std::size_t i = 0, row = 0; i < n; ++i) {
      const bool is_newest = read_.empty() || !read_.contains(ids[i]);
      LandmarkIndex landmark = kNoLandmark;
      const std::size_t end = row + (several ? row_counts[i] : 1);
      for (const std::size_t first = row; row < end; ++row) {
        const std::size_t size = packed_sum_size(counts[row], dim);
        const Sum sum = unpack_sum(sums.first(size), counts[row], dim);
        sums = sums.subspan(size);
        if (std::any_of(sum.begin(), sum.begin() + dim,
                        [&](int s) { return std::abs(s) > 127 * counts[row]; })) {
          file.fail("landmark ", ids[i], " has an impossible prototype");
        }
        const std::uint16_t appearance = several ? appearances[row] : 0;
        if (appearance >> store_.appearance_bits() != 0 ||
            (row > first && appearance <= appearances[row - 1])) {
          file.fail("the appearances of landmark ", ids[i], " do not ascend");
        }
        if (!is_newest) continue;
        const Row to = store_.create_row(ids[i], landmark, appearance);
        store_.set(to, sum, counts[row]);
      }
      if (positions.empty()) continue;
      landmarks.push_back(landmark);
      const bool finite =
          std::ranges::all_of(positions[i], [](double x) { return std::isfinite(x); });
      if (!finite && has_position(positions[i])) {
        file.fail("landmark ", ids[i], " has no finite position");
      }
    }
    // After the landmarks, so that room for positions is made once.
    for (std::size_t i = 0; i < positions.size(); ++i) {
      if (landmarks[i] != kNoLandmark) store_.set_position(landmarks[i], positions[i]);
    }
  }

  const Encoder& encoder_;
  PrototypeStore& store_;
  MapState& state_;
  IdSet read_;  // landmarks that later commits name
  std::optional<Metadata> metadata_;
  std::optional<std::vector<std::int8_t>> centroids_;
};

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
  const std::vector<std::int8_t>& centroids = state.store.quantizer().centroids();
  if (!centroids.empty()) file.add(section::kCentroids, std::as_bytes(std::span(centroids)));
  add_landmarks(file, state.store);
  return file;
}

// Adds the changes to the record of a commit, and returns its bytes.
std::vector<std::byte> serialize(ContainerWriter& record, const MapState& state,
                                 const Uncommitted& changes) {
  std::vector<std::int64_t> ids(changes.ids().begin(), changes.ids().end()), removed;
  std::ranges::sort(ids);
  std::vector<LandmarkIndex> existing;
  for (const std::int64_t id : ids) {
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
    record.add(section::kCentroids, std::as_bytes(std::span(state.store.quantizer().centroids())));
  }
  return record.serialize();
}

}  // namespace

std::unique_ptr<MapState> read_map(const ContainerReader& file, const JournalContent& journal) {
  file.expect(FileKind::learning_map);
  auto encoder = read_encoder(file);
  const std::size_t dim = read_shape(file, *encoder).dim;
  auto state = std::make_unique<MapState>(std::move(encoder), dim, read_appearance_bits(file, dim));
  Reading reading(*state);
  const auto commits = journal.commits(file.identity());
  for (auto commit = commits.rbegin(); commit != commits.rend(); ++commit) {
    const std::string name = text(journal.name(), ": record at byte ", commit->offset);
    reading.read_commit(ContainerReader(commit->bytes, name));
  }
  reading.read_map(file);
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
  return PrototypeMap(read_map(both.file(), both.journal()));
}

bool PrototypeMap::has_journal() const {
  const std::scoped_lock committing(state_->journal_mutex);
  return state_->journal != nullptr;
}

Journal& MapState::need_journal() const {
  if (journal) return *journal;
  invalid("this map has no journal: open it with a journal to commit");
}

std::size_t PrototypeMap::commit() {
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
    if (!uncommitted.incomplete()) {
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
