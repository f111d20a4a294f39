#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>

#include "aligned_copy.h"
#include "answers.h"
#include "protomark/error.h"
#include "protomark/map_file.h"
#include "protomark/prototypes.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

// On a disk in memory where there is one; a file name for this process.
const fs::path& scratch() {
  static const fs::path path =
      (fs::is_directory("/dev/shm") ? fs::path("/dev/shm") : fs::temp_directory_path()) /
      ("protomark_fuzz_" + std::to_string(::getpid()));
  return path;
}

std::vector<char> saved(const PrototypeMap& map) {
  map.save(scratch());
  std::ifstream file(scratch(), std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

std::vector<std::vector<float>> rounded_looks(const PrototypeMap& map, std::int64_t id) {
  std::vector<std::vector<float>> result;
  for (Look& look : map.looks(id)) {
    for (float& v : look.mean) v = std::round(v);  // halves away from zero
    result.push_back(std::move(look.mean));
  }
  return result;
}

// What was added can be taken back, and nothing is left of it.
void change(PrototypeMap& map) {
  test::Random random(4);
  const std::size_t n = 20, dim = map.dim();
  const auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  const auto ids = random.integers<std::int64_t>(n, 1'000'000, 1'000'005);
  const std::size_t before = map.prototype_count();
  for (const std::int64_t id : map.ids()) {
    if (id >= 1'000'000 && id <= 1'000'005) return;
  }
  const auto whole = saved(map);
  map.add_codes(ids, {codes.data(), n, dim});
  EXPECT(map.prototype_count() > before);
  map.remove_codes(ids, {codes.data(), n, dim});
  EXPECT(saved(map) == whole);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    PrototypeMap map = PrototypeMap::parse(input.bytes(), "input");
    fuzz::search_map(map, [&](std::int64_t id) { return rounded_looks(map, id); });
    const auto ids = fuzz::first_ids(map.ids());
    std::vector<float> means(ids.size() * map.dim());
    map.prototypes(ids, {means.data(), ids.size(), map.dim()});
    map.counts(ids);
    map.positions(ids);
    change(map);
    try {
      map.seal(scratch(), size % 2 == 0 ? 8 : 4, 1.0, size % 3 == 0 ? 16 : 32);
      const SealedMap sealed(scratch());
      EXPECT(sealed.ids() == map.ids());
      EXPECT(sealed.metadata() == map.metadata());
      EXPECT(sealed.summary().placed == map.summary().placed);
    } catch (const std::invalid_argument&) {  // positions too far apart for 32 bits
    }
    map.drop_index();
    PrototypeMap joined(map.encoder(), map.dim(), map.look_bits());
    for (const PrototypeMap& part : map.split(ids)) joined.update(part);
    EXPECT(saved(joined) == saved(map));
    if (ids.size() >= 2) {
      map.merge(std::span(ids).first(1), std::span(ids).subspan(1, 1));
      map.discard(std::span(ids).first(1));
      EXPECT(map.size() + 2 == joined.size());
    }
  } catch (const FileError&) {
  }
  return 0;
}
