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

// A map of words answers by the numbers that it returns, which are the words nearest to the rounded
// means.
void test_words(const PrototypeMap& map, Codes queries, const fs::path& path) {
  map.seal(path, test::in_words(map));
  verify_file(path);
  const SealedMap mapped(path);
  const std::size_t dim = map.dim();
  CHECK(mapped.dim() == dim && mapped.words() == dim / 2);
  CHECK(mapped.ids() == map.ids());
  const auto ids = map.ids();
  const Matrix<float> means = map.prototypes(ids), stored = mapped.prototypes(ids);
  const std::vector<std::int8_t>& words = map.encoder()->codebooks()[0].words;
  for (std::size_t i = 0; i < means.data.size(); i += 2) {
    const float x = std::round(means.data[i]), y = std::round(means.data[i + 1]);
    const auto distance = [&](float a, float b) { return (a - x) * (a - x) + (b - y) * (b - y); };
    for (std::size_t word = 0; word < 256; ++word) {
      const std::size_t at = (i % dim / 2 * 256 + word) * 2;
      CHECK(distance(stored.data[i], stored.data[i + 1]) <= distance(words[at], words[at + 1]));
    }
  }

  PrototypeMap expanded(map.encoder());
  const std::vector<std::int8_t> codes(stored.data.begin(), stored.data.end());
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
    const double counts = appearance_bits == 0 ? 0 : 1, all8 = 12 * m / n + counts;
    for (const auto& bytes : {std::optional<double>(), {all8}, {1e9}}) {
      const SealedMap lossless = sealed(bytes);
      CHECK(lossless.words() == 0 && lossless.prototype_count() == map.prototype_count());
      CHECK(lossless.search_codes({codes.data(), 50, 12}) ==
            map.search_codes({codes.data(), 50, 12}));
    }
    CHECK(sealed(6 * m / n + counts).prototype_count() == map.prototype_count());
    // As many words of three numbers as fit, unless 1.1 times as many of two do.
    const std::pair<double, std::pair<std::size_t, std::size_t>> formats[] = {
        {2, {6, 2}},  {2.99, {6, 2}}, {3, {9, 3}},   {4.5, {12, 4}},         {5, {10, 5}},
        {6, {12, 6}}, {9, {12, 6}},   {20, {12, 6}}, {all8 - 1 / n, {12, 6}}};
    for (const auto& [bytes, format] : formats) {
      const SealedMap one = sealed(bytes);
      if (bytes >= all8) continue;
      CHECK(std::pair(one.dim(), one.words()) == format);
      CHECK(one.bytes_per_landmark() <= bytes * (1 + 1e-12));
      const auto rows = static_cast<double>(one.prototype_count());
      const auto words = static_cast<double>(one.words());
      // One prototype more would not fit.
      CHECK(rows == m || (words * (rows + 1) + n) / n > bytes);
      const auto& dims = encoder->dims();
      if (appearance_bits != 0 || std::ranges::find(dims, one.dim()) == dims.end()) continue;
      // Prototypes of fewer numbers begin those of all.
      PrototypeMap shorter(encoder, one.dim());
      std::vector<std::int8_t> prefixes;
      for (std::size_t i = 0; i < 4000; ++i) {
        prefixes.insert(prefixes.end(), &codes[i * 12], &codes[i * 12] + one.dim());
      }
      shorter.add_codes(landmarks, {prefixes.data(), 4000, one.dim()});
      const fs::path other = path.string() + ".shorter";
      shorter.seal(other, {.bytes_per_landmark = bytes});
      const Codes queries{prefixes.data(), 50, one.dim()};
      CHECK(SealedMap(other).prototypes(map.ids()) == one.prototypes(map.ids()));
      CHECK(SealedMap(other).search_codes(queries) == one.search_codes(queries));
    }
    for (const double bytes : {1.999, 0.0, -1.0, std::nan("")}) {
      CHECK(check::throws<std::invalid_argument>([&] { sealed(bytes); },
                                                 "bytes_per_landmark must be at least 2"));
    }
  }
}

// Encoders without codebooks seal maps as they are.
void test_without_codebooks(const fs::path& path) {
  const auto with = test::random_encoder();
  const auto without = std::make_shared<const Encoder>(
      Encoder(with->info(), with->layers(), with->dims(), with->scale()));
  PrototypeMap map(without);
  const std::vector<std::int8_t> code(12, 5);
  map.add_codes(std::vector<std::int64_t>{3}, {code.data(), 1, 12});
  map.seal(path, {.bytes_per_landmark = 12});
  CHECK(SealedMap(path).words() == 0);
  CHECK(check::throws<std::invalid_argument>(
      [&] { map.seal(path, {.bytes_per_landmark = 11.9}); },
      "bytes_per_landmark needs codebooks, which encoder 'tiny' does not have"));
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
  CHECK(mapped.words() == 0);
  CHECK(mapped.positions(std::span(ids).first(1))[0] == here);

  const Codes queries{codes.data(), n, dim};
  CHECK(read.search_codes(queries, 3) == map.search_codes(queries, 3));
  CHECK(mapped.search_codes(queries, 3) == map.search_codes(queries, 3));

  test_words(map, queries, folder / "map.words.pmk");
  CHECK(SealedMap(folder / "map.words.pmk").positions(std::span(ids).first(1))[0] == here);

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
  test_without_codebooks(folder / "bytes.pmk");
  fs::resize_file(sealed, fs::file_size(sealed) - 1);
  CHECK(check::throws<FileError>([&] { SealedMap{sealed}; }, "cut off"));
  fs::remove_all(folder);
  return check::result();
}
