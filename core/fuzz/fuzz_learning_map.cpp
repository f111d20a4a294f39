#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>

#include "aligned_copy.h"
#include "answers.h"
#include "protomark/protomark.h"
#include "sealing.h"

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

// Added observations can be subtracted, after which the map is as before.
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
  map.subtract_codes(ids, {codes.data(), n, dim});
  EXPECT(saved(map) == whole);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    PrototypeMap map = PrototypeMap::parse(input.bytes(), "input");
    fuzz::search_map(map, [&](std::int64_t id) { return fuzz::rounded_appearances(map, id); });
    const auto ids = fuzz::first_ids(map.ids());
    map.prototypes(ids);
    map.counts(ids);
    map.positions(ids);
    change(map);
    try {
      SealOptions options{.position_bits = size % 3 == 0 ? 16 : 32};
      if (size % 2 == 0) options = test::in_words(map, 1.5);
      map.seal(scratch(), options);
      const SealedMap sealed(scratch());
      EXPECT(sealed.ids() == map.ids());
      EXPECT(sealed.metadata() == map.metadata());
      EXPECT(sealed.summary().landmarks_with_position == map.summary().landmarks_with_position);
    } catch (const std::invalid_argument&) {  // no codebooks, or positions too far apart
    }
    map.drop_index();
    PrototypeMap whole_again(map.encoder(), map.dim(), map.appearance_bits());
    for (const PrototypeMap& part : map.split_by_id(ids)) whole_again.merge_map(part);
    EXPECT(saved(whole_again) == saved(map));
    if (ids.size() >= 2) {
      map.merge_landmarks(std::span(ids).first(1), std::span(ids).subspan(1, 1));
      map.remove(std::span(ids).first(1));
      EXPECT(map.size() + 2 == whole_again.size());
    }
  } catch (const FileError&) {
  }
  return 0;
}
