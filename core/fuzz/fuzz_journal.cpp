#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

#include "aligned_copy.h"
#include "answers.h"
#include "journal_base.h"
#include "protomark/protomark.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

using Content = std::vector<char>;

// On a disk in memory where there is one; a file name for this process.
fs::path scratch(const std::string& suffix) {
  const fs::path shared = "/dev/shm";
  return (fs::is_directory(shared) ? shared : fs::temp_directory_path()) /
         ("protomark_fuzz_" + std::to_string(::getpid()) + suffix);
}

Content saved(const PrototypeMap& map) {
  const fs::path path = scratch("");
  map.save(path);
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

void write(const fs::path& path, std::span<const std::byte> bytes) {
  std::ofstream(path, std::ios::binary)
      .write(reinterpret_cast<const char*>(bytes.data()),
             static_cast<std::streamsize>(bytes.size()));
}

// Files with the same bytes give the same map, which can be changed and committed.
void go_on(const PrototypeMap& map, std::span<const std::byte> base,
           std::span<const std::byte> journal) noexcept {
  const fs::path path = scratch(".map");
  write(path, base);
  write(path.string() + ".journal", journal);
  verify_file(path);
  PrototypeMap opened = PrototypeMap::load(path, true);
  EXPECT(saved(opened) == saved(map));
  fuzz::observe(opened, 5, 2);
  EXPECT(opened.commit() > 0);
  EXPECT(file_journal(path)->torn_bytes == 0);
  EXPECT(saved(PrototypeMap::load(path)) == saved(opened));
  opened.compact();
  EXPECT(saved(PrototypeMap::load(path)) == saved(opened));
  EXPECT(file_journal(path)->commits == 0);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const std::vector<Content> bases = [] {
    std::vector<Content> result;
    for (const PrototypeMap& map : fuzz::journal_bases()) result.push_back(saved(map));
    return result;
  }();
  const fuzz::AlignedCopy input(data, size);
  for (const Content& content : bases) {
    const auto base = std::as_bytes(std::span(content));
    try {
      const PrototypeMap map = PrototypeMap::parse(base, "input", input.bytes());
      fuzz::search_map(map, [&](std::int64_t id) { return fuzz::rounded_appearances(map, id); });
      map.positions(map.ids());
      // Files take the longest by far.
      if (size / 64 % 8 == 0) go_on(map, base, input.bytes());
    } catch (const FileError&) {
    }
  }
  return 0;
}
