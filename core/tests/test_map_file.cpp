#include "protomark/map_file.h"

#include <unistd.h>

#include <fstream>

#include "check.h"
#include "protomark/error.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

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
  CHECK(mapped.positions(std::span(ids).first(1))[0] == here);

  std::vector<std::int64_t> found(3 * n), found_read(3 * n), found_mapped(3 * n);
  std::vector<float> distance(3 * n), distance_read(3 * n), distance_mapped(3 * n);
  const Codes queries{codes.data(), n, dim};
  map.search_codes(queries, {}, {found.data(), n, 3}, {distance.data(), n, 3});
  read.search_codes(queries, {}, {found_read.data(), n, 3}, {distance_read.data(), n, 3});
  mapped.search_codes(queries, {}, {found_mapped.data(), n, 3}, {distance_mapped.data(), n, 3});
  CHECK(found == found_read && distance == distance_read);
  CHECK(found == found_mapped && distance == distance_mapped);

  std::ofstream(folder / "text.pmk") << "no map";
  CHECK(check::throws<FileError>([&] { map_kind(folder / "text.pmk"); }, "not a Protomark file"));
  CHECK(check::throws<FileError>([&] { SealedMap{open}; }, "it holds an open map"));
  fs::resize_file(sealed, fs::file_size(sealed) - 1);
  CHECK(check::throws<FileError>([&] { SealedMap{sealed}; }, "cut off"));
  fs::remove_all(folder);
  return check::result();
}
