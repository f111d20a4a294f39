#include "protomark/map_file.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <fstream>

#include "check.h"
#include "file/container.h"
#include "protomark/error.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

// A map of 4 bits answers as one of the numbers that it gives back, and those are the levels
// nearest to the rounded means.
void test_four_bits(const PrototypeMap& map, Codes queries, const fs::path& path) {
  map.seal(path, 4);
  verify_file(path);
  const SealedMap mapped(path);
  CHECK(mapped.code_bits() == 4);
  CHECK(mapped.ids() == map.ids());
  const auto ids = map.ids();
  const std::size_t n = ids.size(), dim = map.dim();
  CHECK(mapped.counts(ids) == map.counts(ids));
  std::vector<float> means(n * dim), levels(n * dim);
  map.prototypes(ids, {means.data(), n, dim});
  mapped.prototypes(ids, {levels.data(), n, dim});
  const float half_step = std::abs(*std::min_element(
      levels.begin(), levels.end(), [](float a, float b) { return std::abs(a) < std::abs(b); }));
  for (std::size_t i = 0; i < n * dim; ++i) {
    const float rounded = std::round(means[i]);
    for (int u = 0; u < 16; ++u) {
      const float level = half_step * static_cast<float>(2 * u - 15);
      CHECK(std::abs(rounded - levels[i]) <= std::abs(rounded - level));
    }
  }

  PrototypeMap expanded(map.encoder());
  std::vector<std::int8_t> codes(levels.begin(), levels.end());
  expanded.add_codes(ids, {codes.data(), n, dim});
  for (const std::size_t k : {1, 3}) {
    SearchOptions options;
    options.threads = 2;
    if (k == 1) options.ratio = 0.9;
    std::vector<std::int64_t> a(k * queries.rows), b(a.size());
    std::vector<std::int32_t> distance_a(a.size()), distance_b(a.size());
    expanded.search_codes(queries, options, {a.data(), queries.rows, k},
                          {distance_a.data(), queries.rows, k});
    mapped.search_codes(queries, options, {b.data(), queries.rows, k},
                        {distance_b.data(), queries.rows, k});
    CHECK(a == b && distance_a == distance_b);
  }
  CHECK(check::throws<std::invalid_argument>([&] { map.seal(path, 5); }, "8 or 4 bits"));
}

}  // namespace

int main() {
  const fs::path folder =
      fs::temp_directory_path() / ("protomark_test_" + std::to_string(::getpid()));
  fs::create_directory(folder);
  const auto encoder = test::random_encoder();
  const std::size_t n = 500, dim = 12;
  test::Random random(6);
  const auto ids = random.integers<std::int64_t>(n, 0, 1000000);
  const auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  PrototypeMap map(encoder);
  map.add_codes(ids, {codes.data(), n, dim});
  const Position here = {1.5, -2.5, 1e6};
  map.set_positions(std::span(ids).first(1), std::span(&here, 1));

  const fs::path open = folder / "map.pmk", sealed = folder / "map.sealed.pmk";
  map.save(open);
  map.seal(sealed);
  CHECK(map_kind(open) == MapKind::open);
  CHECK(map_kind(sealed) == MapKind::sealed);
  verify_file(open);
  verify_file(sealed);
  const PrototypeMap read = PrototypeMap::load(open);
  const SealedMap mapped(sealed);
  CHECK(read.ids() == map.ids());
  CHECK(mapped.ids() == map.ids());
  CHECK(mapped.code_bits() == 8);
  CHECK(mapped.positions(std::span(ids).first(1))[0] == here);

  std::vector<std::int64_t> found(3 * n), found_read(3 * n), found_mapped(3 * n);
  std::vector<std::int32_t> distance(3 * n), distance_read(3 * n), distance_mapped(3 * n);
  const Codes queries{codes.data(), n, dim};
  map.search_codes(queries, {}, {found.data(), n, 3}, {distance.data(), n, 3});
  read.search_codes(queries, {}, {found_read.data(), n, 3}, {distance_read.data(), n, 3});
  mapped.search_codes(queries, {}, {found_mapped.data(), n, 3}, {distance_mapped.data(), n, 3});
  CHECK(found == found_read && distance == distance_read);
  CHECK(found == found_mapped && distance == distance_mapped);

  test_four_bits(map, queries, folder / "map.4.pmk");
  CHECK(SealedMap(folder / "map.4.pmk").positions(std::span(ids).first(1))[0] == here);

  for (const std::string name : {"\xff\xfe", "\x1b[2J", "a\tb", "caf\xc3\xa9"}) {
    ContainerWriter named(FileKind::open_map);
    named.add(name, Bytes());
    named.write(folder / "named.pmk");
    CHECK(check::throws<FileError>([&] { file_sections(folder / "named.pmk"); },
                                   "named.pmk: its section table is broken: a name is not"));
  }

  std::ofstream(folder / "text.pmk") << "no map";
  CHECK(check::throws<FileError>([&] { map_kind(folder / "text.pmk"); }, "not a Protomark file"));
  CHECK(check::throws<FileError>([&] { SealedMap{open}; }, "it holds an open map"));
  fs::resize_file(sealed, fs::file_size(sealed) - 1);
  CHECK(check::throws<FileError>([&] { SealedMap{sealed}; }, "cut off"));
  fs::remove_all(folder);
  return check::result();
}
