// An open map as a file, and the journal beside it.
#include <algorithm>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <stdexcept>
#include <string>
#include <utility>

#include "file/container.h"
#include "file/journal.h"
#include "file/sections.h"
#include "map/landmark_sections.h"
#include "map/map_content.h"
#include "map/prototype_store.h"

namespace protomark {
void PrototypeMap::write(const std::filesystem::path& path,
                         const std::function<void(const std::string&)>& before) const {
  const LandmarkSections landmarks(*store_);
  const std::vector<std::int8_t>& cells = store_->cells().centroids();

  ContainerWriter file(FileKind::open_map, !cells.empty() ? 3 : look_bits() != 0 ? 2 : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(landmarks.shape()));
  add_metadata(file, store_->metadata);
  landmarks.add_to(file);
  if (!cells.empty()) file.add(section::kCells, std::as_bytes(std::span(cells)));
  file.write(path, before);
}

void PrototypeMap::save(const std::filesystem::path& path) const {
  std::error_code error;
  // Another name of the same file (a hard link) is another file to write.
  if (std::filesystem::canonical(path, error) == store_->journaled && !error) {
    const std::scoped_lock own(store_->journal_mutex);
    if (store_->journal) return fold();
  }
  const JournalGuard guard(path);
  std::optional<JournalGuard> last;  // somebody may have begun a journal meanwhile
  const std::shared_lock changing(store_->changing);
  write(path, [&](const std::string&) { last.emplace(path); });
}

PrototypeMap PrototypeMap::read(const ContainerReader& file, const JournalContent& journal) {
  file.expect(FileKind::open_map);
  auto encoder = read_encoder(file);
  const MapShape shape = read_shape(file, *encoder);
  PrototypeMap map(encoder, shape.dim, read_look_bits(file, shape.dim));
  Store& store = *map.store_;
  OpenMapContent content = read_open_map(file, journal, *encoder, store);
  store.metadata = std::move(content.metadata);
  if (!content.cells.empty()) {
    // Nobody searches yet.
    store.put_into_cells({std::move(content.cells), shape.dim}, 1, true);
  }
  return map;
}

PrototypeMap PrototypeMap::parse(std::span<const std::byte> bytes, const std::string& name,
                                 std::span<const std::byte> journal) {
  return read(ContainerReader(bytes, name), JournalContent(journal, name + ".journal"));
}

PrototypeMap PrototypeMap::load(const std::filesystem::path& path, bool journal) {
  if (journal) return load_with_journal(path);
  const JournaledFile both(path);
  return read(both.file(), both.journal());
}

PrototypeMap PrototypeMap::load_with_journal(const std::filesystem::path& path) {
  {
    const MappedFile mapped(path);  // no journal is made for what is no map
    ContainerReader(mapped.bytes(), path.string()).expect(FileKind::open_map);
  }
  auto journal = std::make_unique<Journal>(path);
  try {
    const MappedFile mapped(path);
    const ContainerReader file(mapped.bytes(), path.string());
    const auto bytes = journal->read();
    const JournalContent commits(bytes, journal_path(path).string());
    PrototypeMap map = read(file, commits);
    journal->resume(commits, file.identity());
    map.store_->track_changes();
    map.store_->journaled = journal->map();
    map.store_->journal = std::move(journal);
    return map;
  } catch (...) {
    if (journal) journal->abandon();  // nor for one that is broken
    throw;
  }
}

bool PrototypeMap::has_journal() const {
  const std::scoped_lock own(store_->journal_mutex);
  return store_->journal != nullptr;
}

Journal& PrototypeMap::journal() const {
  if (store_->journal) return *store_->journal;
  throw std::invalid_argument("this map has no journal: open it with one to commit");
}

std::size_t PrototypeMap::commit() {
  const std::scoped_lock own(store_->journal_mutex);
  Journal& journal = this->journal();
  ContainerWriter file = journal.record(FileKind::commit);
  std::vector<std::byte> record;
  Changes changes;
  {
    // What is to be written is copied, so that nobody waits for the disk.
    const std::shared_lock changing(store_->changing);
    Changes& uncommitted = store_->uncommitted();
    if (uncommitted.empty()) return 0;
    if (!uncommitted.incomplete()) {
      record = serialize(file, uncommitted);
      changes = std::exchange(uncommitted, {});
    }
  }
  if (record.empty()) {
    fold();
    return 0;
  }
  try {
    journal.append(record);
  } catch (...) {
    const std::unique_lock changing(store_->changing);
    store_->uncommitted().insert(changes);
    throw;
  }
  return record.size();
}

std::vector<std::byte> PrototypeMap::serialize(ContainerWriter& file,
                                               const Changes& changes) const {
  std::vector<std::int64_t> ids(changes.ids().begin(), changes.ids().end()), gone;
  std::sort(ids.begin(), ids.end());
  std::vector<std::uint32_t> there;
  for (const std::int64_t id : ids) {
    const std::uint32_t landmark = store_->find(id);
    if (landmark == Store::kNone) {
      gone.push_back(id);
    } else {
      there.push_back(landmark);
    }
  }
  const LandmarkSections landmarks(*store_, std::move(there));
  file.add(section::kShape, write_shape(landmarks.shape()));
  if (!gone.empty()) file.add(section::kGone, std::as_bytes(std::span(gone)));
  landmarks.add_to(file);
  if (changes.metadata) {
    // Nothing, where all is gone; absent it would mean that it is as before.
    store_->metadata.empty() ? file.add(section::kMetadata, Bytes())
                             : add_metadata(file, store_->metadata);
  }
  if (changes.cells) {
    file.add(section::kCells, std::as_bytes(std::span(store_->cells().centroids())));
  }
  return file.serialize();
}

void PrototypeMap::compact() {
  const std::scoped_lock own(store_->journal_mutex);
  fold();
}

void PrototypeMap::fold() const {
  Journal& journal = this->journal();
  std::string identity;
  {
    const std::shared_lock changing(store_->changing);
    write(journal.map(), [&](const std::string& written) {
      journal.fold(written);
      identity = written;
    });
    store_->uncommitted() = {};
  }
  journal.restart(identity);
}

void PrototypeMap::close() {
  const std::scoped_lock own(store_->journal_mutex);
  const std::unique_lock changing(store_->changing);
  store_->forget_changes();
  store_->journal.reset();
}

}  // namespace protomark
