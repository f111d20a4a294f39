#include "protomark/map_file.h"

#include "file/journal.h"
#include "map/map_sections.h"

namespace protomark {
namespace {

MapKind kind_of(const ContainerReader& file) {
  if (file.kind() == FileKind::learning_map) return MapKind::learning;
  if (file.kind() == FileKind::sealed_map) return MapKind::sealed;
  file.fail("it holds ", describe(file.kind()), ", not a map");
}

}  // namespace

MapKind map_kind(const std::filesystem::path& path) {
  return kind_of(ContainerReader(MappedFile(path).bytes(), path.string()));
}

std::shared_ptr<const Encoder> map_encoder(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  kind_of(file);
  return read_encoder(file);
}

void expect_encoder(const Encoder& encoder, const Encoder& expected, const std::string& map) {
  if (encoder.identity() == expected.identity()) return;
  const auto describe = [](const Encoder& e) {
    return "'" + e.info().name + "' (identity " + e.identity().substr(0, 12) + ")";
  };
  invalid(map, ": it was made with encoder ", describe(encoder), ", not with ", describe(expected),
          ": use the map's encoder, or build the map with the other");
}

void expect_descriptor(const Encoder& encoder, const std::string& descriptor,
                       const std::string& map) {
  if (encoder.info().descriptor == descriptor) return;
  invalid(map, ": it is a map of ", encoder.info().descriptor, " descriptors, not of ", descriptor);
}

std::vector<std::pair<std::string, std::size_t>> file_sections(const std::filesystem::path& path) {
  return ContainerReader(MappedFile(path).bytes(), path.string()).sections();
}

void verify_file(const std::filesystem::path& path) {
  const JournaledFile both(path);
  both.file().verify();
  both.journal().commits(both.file().identity());
}

std::optional<FileJournal> file_journal(const std::filesystem::path& path) {
  const JournaledFile both(path);
  const JournalContent& journal = both.journal();
  if (journal.size() == 0) return std::nullopt;
  return FileJournal{journal.commits(both.file().identity()).size(), journal.size(),
                     journal.size() - journal.end()};
}

}  // namespace protomark
