// Adding in chunks and pieces, by several threads, and out of memory: the same as one observation
// after the other.
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "check.h"
#include "counted_memory.h"
#include "protomark/map_file.h"
#include "protomark/prototypes.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

// More than two chunks that are encoded (8192) and one piece that searches wait for (2048).
constexpr std::size_t kMany = 2 * 8192 + 2048 + 77, kBytes = 8;
const fs::path path =
    fs::temp_directory_path() / ("protomark_adding_" + std::to_string(::getpid()) + ".pmk");

std::vector<char> bytes_of(const PrototypeMap& map) {
  map.save(path);
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

struct Observations {
  std::vector<std::int64_t> ids;
  std::vector<std::uint8_t> descriptors;

  // Of landmarks first to last; runs of one landmark are long enough to be halved.
  Observations(std::uint32_t seed, std::size_t n, std::int64_t first, std::int64_t last)
      : descriptors(test::Random(seed).integers<std::uint8_t>(n * kBytes, 0, 255)) {
    test::Random random(seed);
    while (ids.size() < n) {
      const auto run = random.integer(0, 99) == 0 ? random.integer(200, 400) : 1;
      ids.resize(std::min(n, ids.size() + static_cast<std::size_t>(run)),
                 random.integer(first, last));
    }
  }
  void add_to(PrototypeMap& map, std::size_t begin, std::size_t n, int threads) const {
    map.add(std::span(ids).subspan(begin, n), {&descriptors[begin * kBytes], n, kBytes}, threads);
  }
  std::vector<std::int8_t> codes(const Encoder& encoder) const {
    std::vector<std::int8_t> result(ids.size() * encoder.dim());
    encoder.encode({descriptors.data(), ids.size(), kBytes},
                   {result.data(), ids.size(), encoder.dim()});
    return result;
  }
};

// Known, new and repeated landmarks in one batch.
void test_threads(std::size_t look_bits, std::size_t dim, std::size_t cells) {
  const auto encoder = test::random_encoder(64, dim);
  const Observations first(1, 3000, 0, 999), more(2, kMany, 500, 2499);
  const auto begun = [&] {
    PrototypeMap map(encoder, dim, look_bits);
    first.add_to(map, 0, first.ids.size(), 1);
    if (cells != 0) map.build_index(cells);
    return map;
  };
  PrototypeMap single = begun();
  for (std::size_t i = 0; i < kMany; ++i) more.add_to(single, i, 1, 1);
  const std::vector<char> expected = bytes_of(single);
  for (const int threads : {1, 2, 5}) {
    PrototypeMap map = begun();
    more.add_to(map, 0, kMany, threads);
    CHECK(bytes_of(map) == expected);
  }
  PrototypeMap encoded = begun();
  encoded.add_codes(more.ids, {more.codes(*encoder).data(), kMany, dim});
  CHECK(bytes_of(encoded) == expected);
}

std::vector<std::int32_t> distances(const PrototypeMap& map, Codes queries) {
  std::vector<std::int64_t> ids(queries.rows);
  std::vector<std::int32_t> result(queries.rows);
  map.search_codes(queries, {}, {ids.data(), queries.rows, 1}, {result.data(), queries.rows, 1});
  return result;
}

// Whichever allocation fails, the map is whole: each observation is in it or not, and its rounded
// prototypes, which search reads, are those of its sums, which a file has.
void test_failures(std::size_t look_bits, std::size_t cells, int threads) {
  const auto encoder = test::random_encoder();
  const Observations first(3, 500, 0, 99), more(4, kMany, 50, 2499);
  const std::vector<std::int8_t> codes = first.codes(*encoder);
  const Codes queries{codes.data(), 100, encoder->dim()};
  int failed = 0;
  bool done = false;
  for (long allowed = 0; !done; allowed += 1 + allowed / 8) {
    PrototypeMap map(encoder, 0, look_bits);
    first.add_to(map, 0, first.ids.size(), 1);
    if (cells != 0) map.build_index(cells);
    test::left = allowed;
    try {
      more.add_to(map, 0, kMany, threads);
      done = true;
    } catch (const std::bad_alloc&) {
      ++failed;
    }
    test::left = -1;
    const std::vector<std::int64_t> ids = map.ids();
    const std::vector<std::uint32_t> counts = map.counts(ids);
    CHECK(std::ranges::find(counts, 0u) == counts.end());
    const std::vector<char> bytes = bytes_of(map);
    const PrototypeMap again = PrototypeMap::load(path);
    CHECK(distances(again, queries) == distances(map, queries));
    map.discard(ids);
    CHECK(map.size() == 0 && map.prototype_count() == 0);
  }
  CHECK(failed > 10);
}

}  // namespace

int main() {
  for (const std::size_t look_bits : {0, 3}) {
    for (const std::size_t cells : {0, 7}) {
      for (const std::size_t dim : {12, 32, 34}) test_threads(look_bits, dim, cells);
      for (const int threads : {1, 2}) test_failures(look_bits, cells, threads);
    }
  }
  fs::remove(path);
  return check::result();
}
