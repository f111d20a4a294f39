#include "map/map_content.h"

#include <optional>
#include <string>
#include <utility>

#include "base/id_set.h"
#include "file/sections.h"
#include "map/landmark_sections.h"

namespace protomark {
namespace {

// What was read, from the newest to the oldest.
struct Reading {
  const Encoder* encoder;
  PrototypeStore* store;
  IdSet known;  // landmarks that came, changed or went later
  std::optional<Metadata> metadata;
  std::optional<std::vector<std::int8_t>> cells;

  void read_commit(const ContainerReader& commit) {
    const MapShape shape = read_shape(commit, *encoder);
    if (shape.dim != store->dim() || read_look_bits(commit, shape.dim) != store->look_bits()) {
      commit.fail("its dimension or look bits are not the map's");
    }
    read_landmarks(commit, shape, known, *store);
    for (const char* name : {section::kIds, section::kGone}) {
      const auto bytes = commit.map_if_there(name);
      if (!bytes) continue;
      const auto ids = read_section<std::int64_t>(commit, name, bytes->size() / 8);
      check_ids(commit, ids);
      for (const std::int64_t id : ids) known.insert(id);
    }
    if (const auto bytes = commit.map_if_there(section::kCells)) {
      auto own = bytes->empty() ? std::vector<std::int8_t>() : read_cells(commit, shape.dim);
      if (!cells) cells = std::move(own);
    }
    if (commit.map_if_there(section::kMetadata)) {
      auto own = read_metadata(commit);
      if (!metadata) metadata = std::move(own);
    }
  }
};

}  // namespace

// The last commit comes first: what is older and known by then is left out, so that nothing that
// was read has to be found and taken back.
OpenMapContent read_open_map(const ContainerReader& file, const JournalContent& journal,
                             const Encoder& encoder, PrototypeStore& store) {
  Reading reading{&encoder, &store, {}, {}, {}};
  const auto commits = journal.commits(file.identity());
  for (auto commit = commits.rbegin(); commit != commits.rend(); ++commit) {
    const std::string name = journal.name() + ": record at byte " + std::to_string(commit->offset);
    reading.read_commit(ContainerReader(commit->bytes, name));
  }
  auto metadata = read_metadata(file);
  auto cells = read_cells(file, store.dim());
  read_landmarks(file, read_shape(file, encoder), reading.known, store);
  return {reading.metadata ? std::move(*reading.metadata) : std::move(metadata),
          reading.cells ? std::move(*reading.cells) : std::move(cells)};
}

}  // namespace protomark
