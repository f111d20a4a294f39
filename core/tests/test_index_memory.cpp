// Memory beside the map while an index is built, and maps that run out of memory meanwhile.
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <numeric>
#include <string>
#include <vector>

#include "check.h"
#include "counted_memory.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 32;

std::shared_ptr<const Encoder> encoder() {
  test::Random random(5);
  std::vector<Layer> layers{test::random_layer(random, 64, kDim)};
  return std::make_shared<const Encoder>(
      Encoder({"x", "test", "none", "none", {}}, std::move(layers), {kDim}, 1.0f));
}

PrototypeMap map_of(std::size_t n, std::size_t appearance_bits, bool placed) {
  test::Random random(6);
  PrototypeMap map(encoder(), kDim, appearance_bits);
  std::vector<std::int64_t> ids(n);
  std::iota(ids.begin(), ids.end(), std::int64_t{0});
  // Backwards, so that ids and rows do not ascend together.
  for (std::int64_t& id : ids) id = 3 * (static_cast<std::int64_t>(n) - id);
  const auto codes = random.integers<std::int8_t>(n * kDim, -127, 127);
  map.add_codes(ids, {codes.data(), n, kDim});
  if (placed) map.set_positions(ids, std::vector<Position>(n, {1, 2, 3}));
  return map;
}

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr std::size_t kLandmarks = 20'000, kTries = 40;
#else
constexpr std::size_t kLandmarks = 500'000, kTries = 400;
#endif
// For any map: the codes from which lists are learned, and buffers.
constexpr double kBuffers = 4 << 20;

// Bytes per landmark.
template <typename Work>
double bytes(const std::string& what, const Work& work) {
  const auto more = static_cast<double>(test::memory_of(work));
  std::printf("%-50s %4.1f bytes a landmark\n", what.c_str(), more / kLandmarks);
  return more / kLandmarks;
}

void test_memory(std::size_t appearance_bits, bool placed) {
  const std::size_t before = test::held;
  PrototypeMap map = map_of(kLandmarks, appearance_bits, placed);
  const double own = static_cast<double>(test::held - before) / kLandmarks;
  const std::string what =
      "appearance bits " + std::to_string(appearance_bits) + (placed ? ", placed" : "");
  std::printf("%-50s %4.1f bytes a landmark\n", what.c_str(), own);
  const double few = 5.5 + kBuffers / kLandmarks, sums = 2 * kDim;
  // Arrays that grew have room; positions did not grow, and are not by row with appearances.
  const double grown = placed && appearance_bits == 0 ? sizeof(Position) : 0;
  CHECK(bytes(what + ": in place", [&] { map.build_index({30, true}); }) < few + grown);
  CHECK(bytes(what + ": in place again", [&] { map.build_index({20, true}); }) < few);
  CHECK(bytes(what + ": beside", [&] { map.build_index({20}); }) > 0.7 * own);
  // Now they have none for the half-filled blocks of more lists, and grow one after the other.
  CHECK(bytes(what + ": in place, no room", [&] { map.build_index({60, true}); }) < few + sums);
}

struct State {
  std::vector<std::int64_t> ids;
  std::vector<std::uint32_t> counts;
  Matrix<float> prototypes;
  Matches matches;
  std::vector<Position> positions;
  std::size_t nlist, rows;
  bool operator==(const State&) const = default;
};

State state_of(const PrototypeMap& map, Codes queries) {
  const auto ids = map.ids();
  SearchOptions options;
  if (map.nlist() != 0) options.nprobe = 1;
  State s{ids,
          map.counts(ids),
          map.prototypes(ids),
          map.search_codes(queries, 3, options),
          map.positions(ids),
          map.nlist(),
          map.prototype_count()};
  for (Position& p : s.positions) {
    if (std::isnan(p[0])) p = {};
  }
  return s;
}

// Whichever allocation fails, the map is as before.
void test_failures(std::size_t appearance_bits, bool placed, bool in_place) {
  PrototypeMap map = map_of(200, appearance_bits, placed);
  test::Random random(7);
  const auto codes = random.integers<std::int8_t>(20 * kDim, -127, 127);
  const Codes queries{codes.data(), 20, kDim};
  for (const std::size_t nlist : {5, 9, 2}) {
    const State before = state_of(map, queries);
    // Counts the allocations on an equal map.
    PrototypeMap same = map_of(200, appearance_bits, placed);
    const long all = 1L << 40;
    test::left = all;
    same.build_index({nlist, in_place});
    const long needed = all - test::left;
    test::left = -1;
    int failed = 0;
    bool kept = true, done = false;
    for (long allowed = 0; !done; ++allowed) {
      // All of those at the end, where rows move.
      if (allowed + 60 < needed) allowed += needed / static_cast<long>(kTries);
      test::left = allowed;
      try {
        map.build_index({nlist, in_place});
        done = true;
      } catch (const std::bad_alloc&) {
        ++failed;
      }
      test::left = -1;
      if (!done) kept = kept && state_of(map, queries) == before;
    }
    CHECK(failed > 30);
    CHECK(kept);
    CHECK(map.nlist() == nlist);
    const State after = state_of(map, queries);
    CHECK(after.ids == before.ids && after.counts == before.counts);
    CHECK(after.prototypes == before.prototypes);
    // It goes on learning, new landmarks included.
    const std::vector<std::int64_t> landmarks(before.ids.begin(), before.ids.begin() + 20);
    map.add_codes(landmarks, queries);
    map.subtract_codes(landmarks, queries);
    CHECK(state_of(map, queries) == after);
  }
}

}  // namespace

int main() {
  for (const std::size_t appearance_bits : {0, 3}) {
    for (const bool placed : {false, true}) {
      test_memory(appearance_bits, placed);
      for (const bool in_place : {false, true}) test_failures(appearance_bits, placed, in_place);
    }
  }
  return check::result();
}
