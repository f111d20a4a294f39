// A learning map as a file, and the journal beside it.
#include <algorithm>
#include <stdexcept>
#include <string>
#include <utility>

#include "file/sections.h"
#include "map/learning_map_file.h"
#include "map/map_sections.h"
#include "map/map_state.h"

namespace protomark {
namespace {

std::unique_ptr<MapState> read_map(const ContainerReader& file, const JournalContent& journal) {
  file.expect(FileKind::learning_map);
  auto encoder = read_encoder(file);
  const std::size_t dim = read_shape(file, *encoder).dim;
  auto state = std::make_unique<MapState>(encoder, dim, read_appearance_bits(file, dim));
  LearningMapContent content = read_learning_map(file, journal, *encoder, state->store);
  state->metadata = std::move(content.metadata);
  if (!content.centroids.empty()) {
    MapChange(*state).set_centroids({std::move(content.centroids), dim}, 1, true);
  }
  return state;
}

std::unique_ptr<MapState> read_with_journal(const std::filesystem::path& path) {
  {
    const MappedFile mapped(path);  // no journal is made for a file that is no learning map
    ContainerReader(mapped.bytes(), path.string()).expect(FileKind::learning_map);
  }
  auto journal = std::make_unique<Journal>(path);
  try {
    const MappedFile mapped(path);
    const ContainerReader file(mapped.bytes(), path.string());
    const auto bytes = journal->read();
    const JournalContent commits(bytes, journal_path(path).string());
    auto state = read_map(file, commits);
    journal->resume(commits, file.identity());
    state->store.uncommitted() = std::make_unique<Uncommitted>();
    state->journaled = journal->map();
    state->journal = std::move(journal);
    return state;
  } catch (...) {
    if (journal) journal->abandon();  // nor for one that is broken
    throw;
  }
}

// The map as a file that is written as long as `landmarks` is there and the map does not change.
ContainerWriter file_of(const MapState& state, const LandmarkSections& landmarks) {
  ContainerWriter file(FileKind::learning_map);
  file.add(section::kEncoder, state.encoder->serialize());
  add_metadata(file, state.metadata);
  const std::vector<std::int8_t>& centroids = state.store.centroids().centroids();
  if (!centroids.empty()) file.add(section::kCentroids, std::as_bytes(std::span(centroids)));
  landmarks.add_to(file);
  return file;
}

// Adds what changed to the record of a commit, and returns its bytes.
std::vector<std::byte> serialize(ContainerWriter& record, const MapState& state,
                                 const Uncommitted& changes) {
  std::vector<std::int64_t> ids(changes.ids().begin(), changes.ids().end()), removed;
  std::ranges::sort(ids);
  std::vector<LandmarkIndex> existing;
  for (const std::int64_t id : ids) {
    const LandmarkIndex landmark = state.store.find(id);
    if (landmark == kNoLandmark) {
      removed.push_back(id);
    } else {
      existing.push_back(landmark);
    }
  }
  const LandmarkSections landmarks(state.store, std::move(existing));
  landmarks.add_to(record);
  if (!removed.empty()) record.add(section::kRemoved, std::as_bytes(std::span(removed)));
  if (changes.metadata) {
    // An empty section says that there is none any more, an absent one that it did not change.
    state.metadata.empty() ? record.add(section::kMetadata, Bytes())
                           : add_metadata(record, state.metadata);
  }
  if (changes.centroids) {
    record.add(section::kCentroids, std::as_bytes(std::span(state.store.centroids().centroids())));
  }
  return record.serialize();
}

}  // namespace

void PrototypeMap::save(const std::filesystem::path& path) const {
  std::error_code error;
  // Another name of the same file (a hard link) is another file to write.
  if (std::filesystem::canonical(path, error) == state_->journaled && !error) {
    const std::scoped_lock own(state_->journal_mutex);
    if (state_->journal) return state_->fold();
  }
  const std::shared_lock lock(state_->changing);
  const LandmarkSections landmarks(state_->store);
  write_guarded(file_of(*state_, landmarks), path);
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
  const std::scoped_lock own(state_->journal_mutex);
  return state_->journal != nullptr;
}

Journal& MapState::need_journal() const {
  if (journal) return *journal;
  throw std::invalid_argument("this map has no journal: open it with one to commit");
}

std::size_t PrototypeMap::commit() {
  const std::scoped_lock own(state_->journal_mutex);
  Journal& journal = state_->need_journal();
  ContainerWriter file = journal.record(FileKind::commit);
  std::vector<std::byte> record;
  Uncommitted changes;
  {
    // What is to be written is copied, so that changes do not wait for the disk.
    const std::shared_lock lock(state_->changing);
    Uncommitted& uncommitted = *state_->store.uncommitted();
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
    state_->store.uncommitted()->insert(changes);
    throw;
  }
  return record.size();
}

void PrototypeMap::compact() {
  const std::scoped_lock own(state_->journal_mutex);
  state_->fold();
}

void MapState::fold() {
  Journal& own = need_journal();
  std::string identity;
  {
    const std::shared_lock lock(changing);
    const LandmarkSections landmarks(store);
    file_of(*this, landmarks).write(own.map(), [&](const std::string& written) {
      own.fold(written);
      identity = written;
    });
    *store.uncommitted() = {};
  }
  own.restart(identity);
}

void PrototypeMap::close() {
  const std::scoped_lock own(state_->journal_mutex);
  const std::unique_lock lock(state_->changing);
  state_->store.uncommitted().reset();
  state_->journal.reset();
}

}  // namespace protomark
