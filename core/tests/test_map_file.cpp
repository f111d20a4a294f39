#include "protomark/protomark.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <functional>
#include <optional>

#include "check.h"
#include "file/container.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

// A map of 4 bits answers by the numbers that it returns, which are the levels nearest to the
// rounded means.
void test_four_bits(const PrototypeMap& map, Codes queries, const fs::path& path) {
  map.seal(path, test::four_bits(map));
  verify_file(path);
  const SealedMap mapped(path);
  CHECK(mapped.code_bits() == 4);
  CHECK(mapped.ids() == map.ids());
  const auto ids = map.ids();
  CHECK(mapped.counts(ids) == map.counts(ids));
  const Matrix<float> means = map.prototypes(ids), levels = mapped.prototypes(ids);
  const float scale = std::abs(*std::ranges::min_element(
      levels.data, [](float a, float b) { return std::abs(a) < std::abs(b); }));
  for (std::size_t i = 0; i < means.data.size(); ++i) {
    const float rounded = std::round(means.data[i]);
    for (int u = 0; u < 16; ++u) {
      const float level = scale * static_cast<float>(2 * u - 15);
      CHECK(std::abs(rounded - levels.data[i]) <= std::abs(rounded - level));
    }
  }

  PrototypeMap expanded(map.encoder());
  const std::vector<std::int8_t> codes(levels.data.begin(), levels.data.end());
  expanded.add_codes(ids, {codes.data(), ids.size(), map.dim()});
  for (const std::size_t k : {1, 3}) {
    SearchOptions options;
    options.threads = 2;
    if (k == 1) options.ratio = 0.9;
    CHECK(expanded.search_codes(queries, k, options) == mapped.search_codes(queries, k, options));
  }
}

// Sealing keeps everything unless bytes are limited, and then as much as fits.
void test_bytes_per_landmark(const fs::path& path) {
  const auto encoder = test::random_encoder();
  test::Random random(16);
  const auto codes = random.integers<std::int8_t>(4000 * 12, -127, 127);
  const auto landmarks = random.integers<std::int64_t>(4000, 0, 299);
  for (const std::size_t appearance_bits : {0, 4}) {
    PrototypeMap map(encoder, 0, appearance_bits);
    map.add_codes(landmarks, {codes.data(), 4000, 12});
    const auto n = static_cast<double>(map.size()), m = static_cast<double>(map.prototype_count());
    const auto sealed = [&](std::optional<double> bytes) {
      map.seal(path, {.bytes_per_landmark = bytes});
      return SealedMap(path);
    };
    const double counts = appearance_bits == 0 ? 1 : 2, all8 = 12 * m / n + counts;
    for (const auto& bytes : {std::optional<double>(), {all8}, {1e9}}) {
      const SealedMap lossless = sealed(bytes);
      CHECK(lossless.code_bits() == 8 && lossless.prototype_count() == map.prototype_count());
      CHECK(lossless.search_codes({codes.data(), 50, 12}) ==
            map.search_codes({codes.data(), 50, 12}));
    }
    const double all4 = 8 * m / n + counts;
    CHECK(sealed(all8 - 1 / n).code_bits() == 4);
    CHECK(sealed(all4).prototype_count() == map.prototype_count());
    for (const double bytes : {9.0, 9.5, 10.0, 10.5, 13.0, 18.0, 25.3}) {
      const SealedMap one = sealed(bytes);
      CHECK(one.bytes_per_landmark() <= bytes * (1 + 1e-12));
      if (bytes >= all4) continue;
      // One prototype more would not fit.
      const auto rows = static_cast<double>(one.prototype_count());
      CHECK((8 * (rows + 1) + 2 * n) / n > bytes);
    }
    for (const double bytes : {8.999, 0.0, -1.0, std::nan("")}) {
      CHECK(check::throws<std::invalid_argument>([&] { sealed(bytes); },
                                                 "bytes_per_landmark must be at least 9"));
    }
  }
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

  const fs::path learning = folder / "map.pmk", sealed = folder / "map.sealed.pmk";
  map.save(learning);
  map.seal(sealed);
  CHECK(map_kind(learning) == MapKind::learning);
  CHECK(map_kind(sealed) == MapKind::sealed);
  verify_file(learning);
  verify_file(sealed);
  const PrototypeMap read = PrototypeMap::load(learning);
  const SealedMap mapped(sealed);
  CHECK(read.ids() == map.ids());
  CHECK(mapped.ids() == map.ids());
  CHECK(mapped.code_bits() == 8);
  CHECK(mapped.positions(std::span(ids).first(1))[0] == here);

  const Codes queries{codes.data(), n, dim};
  CHECK(read.search_codes(queries, 3) == map.search_codes(queries, 3));
  CHECK(mapped.search_codes(queries, 3) == map.search_codes(queries, 3));

  test_four_bits(map, queries, folder / "map.4.pmk");
  CHECK(SealedMap(folder / "map.4.pmk").positions(std::span(ids).first(1))[0] == here);

  for (const std::string name : {"\xff\xfe", "\x1b[2J", "a\tb", "caf\xc3\xa9"}) {
    ContainerWriter named(FileKind::learning_map);
    named.add(name, Bytes());
    named.write(folder / "named.pmk");
    CHECK(check::throws<FileError>([&] { file_sections(folder / "named.pmk"); },
                                   "named.pmk: its section table is broken: a name is not"));
  }

  std::ofstream(folder / "text.pmk") << "no map";
  CHECK(check::throws<FileError>([&] { map_kind(folder / "text.pmk"); }, "not a Protomark file"));
  CHECK(check::throws<FileError>([&] { SealedMap{learning}; }, "it holds a learning map"));
  CHECK(check::throws<FileError>([&] { PrototypeMap::load(sealed); }, "it holds a sealed map"));
  encoder->save(folder / "model.pme");
  for (const auto& f : {std::function([&] { map_kind(folder / "model.pme"); }),
                        std::function([&] { map_encoder(folder / "model.pme"); })}) {
    CHECK(check::throws<FileError>(f, "it holds an encoder, not a map"));
  }
  test_bytes_per_landmark(folder / "bytes.pmk");
  fs::resize_file(sealed, fs::file_size(sealed) - 1);
  CHECK(check::throws<FileError>([&] { SealedMap{sealed}; }, "cut off"));
  fs::remove_all(folder);
  return check::result();
}
