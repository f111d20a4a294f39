// Opens and checks files.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "module.h"
#include "protomark/map_file.h"
#include "protomark/prototype_map.h"
#include "protomark/sealed_map.h"

namespace protomark::python {
namespace {

// Checks a map file before a journal is made for it, or anything large is read.
void check_map(const Path& path, const Encoder* encoder,
               const std::optional<std::string>& descriptor) {
  if (encoder == nullptr && !descriptor) return;
  without_gil([&] {
    const auto of_map = map_encoder(path);
    if (encoder != nullptr) expect_encoder(*of_map, *encoder, path.string());
    if (descriptor) expect_descriptor(*of_map, *descriptor, path.string());
  });
}

}  // namespace

void bind_files(nb::module_& m) {
  m.def(
      "open",
      [](const Path& path, bool journal, const Encoder* encoder,
         const std::optional<std::string>& descriptor) -> nb::object {
        check_map(path, encoder, descriptor);
        if (journal || without_gil([&] { return map_kind(path); }) == MapKind::learning) {
          return nb::cast(without_gil([&] { return PrototypeMap::load(path, journal); }));
        }
        return nb::cast(without_gil([&] { return SealedMap(path); }));
      },
      "path"_a, nb::kw_only(), "journal"_a = false, "encoder"_a.none() = nb::none(),
      "descriptor"_a = nb::none(), "Open a map file: see `protomark.open`.");
  m.def("file_sections", &file_sections, "path"_a, ReleaseGil(),
        nb::sig("def file_sections(path: str | os.PathLike[str]) -> list[tuple[str, int]]"),
        "Names and sizes in bytes of the sections of a model or map file. Raises FileError.");
  m.def("verify_file", &verify_file, "path"_a, ReleaseGil(),
        nb::sig("def verify_file(path: str | os.PathLike[str]) -> None"),
        "Check every checksum of a model or map file, and of the journal beside it. Raises "
        "FileError.");
  m.def(
      "file_journal",
      [](const Path& path) -> nb::object {
        const auto journal = without_gil([&] { return file_journal(path); });
        if (!journal) return nb::none();
        nb::dict result;
        result["commits"] = journal->commits;
        result["bytes"] = journal->bytes;
        result["torn_bytes"] = journal->torn_bytes;
        return result;
      },
      "path"_a, nb::sig("def file_journal(path: str | os.PathLike[str]) -> dict[str, int] | None"),
      "The journal beside a map file: commits since the file was written, bytes, and how many of "
      "these are of an interrupted commit, which does not count. None if there is no journal. "
      "Raises FileError.");
}

}  // namespace protomark::python
