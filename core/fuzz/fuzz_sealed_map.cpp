#include "aligned_copy.h"
#include "answers.h"
#include "file/container.h"
#include "protomark/protomark.h"

using namespace protomark;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    const SealedMap map(input.bytes(), "input");
    EXPECT(map.prototype_count() >= map.size());
    // The padding of int8 numbers counts, and its zeros are not checked.
    const bool exact = map.words() != 0 || map.dim() % 4 == 0;
    fuzz::search_map(map, [&](std::int64_t id) { return map.appearances(id); }, exact);
    const auto ids = fuzz::first_ids(map.ids());
    map.prototypes(ids);
    for (const Position& p : map.positions(ids)) {
      EXPECT(std::isnan(p[0]) == std::isnan(p[1]) && std::isnan(p[0]) == std::isnan(p[2]));
      EXPECT(!std::isinf(p[0]) && !std::isinf(p[1]) && !std::isinf(p[2]));
    }
    const MapSummary summary = map.summary();
    EXPECT(summary.landmarks_with_position <= map.size());
    const std::int64_t unknown = -1;
    try {
      map.positions(std::span(&unknown, 1));
      EXPECT(false);
    } catch (const UnknownLandmark&) {
    }
    ContainerReader(input.bytes(), "input").verify();
  } catch (const FileError&) {
  }
  return 0;
}
