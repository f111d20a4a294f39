// Memory that saving and sealing take beside the map, and that an opened map takes.
#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <limits>
#include <numeric>
#include <string>

#include <unistd.h>

#include "check.h"
#include "counted_memory.h"
#include "protomark/protomark.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

const fs::path path =
    fs::temp_directory_path() / ("protomark_saving_memory_" + std::to_string(::getpid()));

enum class Ids { ascending, mixed, sparse };

PrototypeMap map_of(std::size_t dim, std::size_t n, Ids kind, std::size_t appearance_bits) {
  test::Random random(5);
  std::vector<Layer> layers{test::random_layer(random, 64, dim)};
  PrototypeMap map(std::make_shared<const Encoder>(
                       Encoder({"x", "test", "none", "none", {}}, std::move(layers), {dim}, 1.0f,
                               {test::random_codebook(random, 2, dim)})),
                   dim, appearance_bits);
  std::vector<std::int64_t> ids(n);
  std::iota(ids.begin(), ids.end(), std::int64_t{0});
  if (kind == Ids::sparse) {
    for (std::int64_t& id : ids) id = id * 7919 + random.integer(0, 7000);
  }
  if (kind != Ids::ascending) {
    for (std::size_t i = n; i > 1; --i) {
      std::swap(ids[i - 1],
                ids[static_cast<std::size_t>(random.integer(0, static_cast<std::int64_t>(i) - 1))]);
    }
  }
  for (int times = 0; times < (appearance_bits == 0 ? 1 : 2); ++times) {
    const auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
    map.add_codes(ids, {codes.data(), n, dim});
  }
  return map;
}

// The default number of landmarks, and memory that does not depend on it.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
// Slower by far, so with smaller maps, for which constant memory matters more.
constexpr std::size_t kLandmarks = 20'000, kBuffers = 5 << 18;
#else
constexpr std::size_t kLandmarks = 200'000, kBuffers = 1 << 19;
#endif

template <typename Save>
void check_save(const std::string& what, std::size_t own, const Save& save) {
  const std::size_t more = test::memory_of(save);
  const double share = static_cast<double>(more) / static_cast<double>(own);
  std::printf("%-60s %9zu bytes of %9zu: %.1f %%\n", what.c_str(), more, own, 100 * share);
  CHECK(more < kBuffers + own / 25);
}

// Every dimension, kind of ids, with an index and without.
struct Case {
  std::size_t dim;
  Ids ids;
  std::size_t appearance_bits;
  bool indexed;
};

constexpr Case kCases[] = {
    {8, Ids::ascending, 0, false}, {8, Ids::mixed, 0, false},  {8, Ids::sparse, 0, false},
    {8, Ids::mixed, 0, true},      {8, Ids::sparse, 0, true},  {8, Ids::sparse, 2, false},
    {8, Ids::sparse, 2, true},     {16, Ids::mixed, 0, false}, {16, Ids::sparse, 0, true},
    {32, Ids::mixed, 0, true},     {32, Ids::sparse, 2, true}, {64, Ids::sparse, 0, false},
    {64, Ids::sparse, 0, true},
};

}  // namespace

// test_saving_memory [landmarks]
int main(int argc, char** argv) {
  const std::size_t landmarks = argc > 1 ? std::strtoull(argv[1], nullptr, 10) : kLandmarks;
  for (const Case& c : kCases) {
    const std::size_t before = test::held;
    PrototypeMap map = map_of(c.dim, landmarks, c.ids, c.appearance_bits);
    if (c.indexed) map.build_index({16});
    const std::size_t own = test::held - before;
    const std::string what = "dim " + std::to_string(c.dim) + ", ids " +
                             std::to_string(static_cast<int>(c.ids)) + ", appearance bits " +
                             std::to_string(c.appearance_bits) + (c.indexed ? ", index" : "");
    check_save(what + ": save", own, [&] { map.save(path); });
    // Once all arrays grew to twice their size with the last landmark.
    const std::size_t closed = test::held;
    const PrototypeMap opened = PrototypeMap::load(path);
    CHECK(test::held - closed < own + own / 4 + kBuffers);
    check_save(what + ": seal", own, [&] { map.seal(path); });
    check_save(what + ": seal, words", own, [&] { map.seal(path, test::in_words(map)); });
  }
  fs::remove(path);
  return check::result();
}
