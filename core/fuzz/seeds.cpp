// Writes small valid files for the fuzzer to start from: seeds FOLDER makes FOLDER/<target>/.
#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <limits>

#include "file/container.h"
#include "file/sections.h"
#include "journal_base.h"
#include "protomark/protomark.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

std::shared_ptr<const Encoder> small_encoder(std::size_t dim, std::size_t layers,
                                             EncoderInput input = {}) {
  test::Random random(static_cast<std::uint32_t>(dim + layers));
  std::vector<Layer> built;
  std::size_t width = 64;
  for (std::size_t l = 1; l < layers; ++l) {
    built.push_back(test::random_layer(random, width, 6));
    width = 6;
  }
  built.push_back(test::random_layer(random, width, dim));
  return std::make_shared<const Encoder>(Encoder(
      {"seed", "test", "none", "none", {{"key", "value"}}}, std::move(built),
      dim > 1 ? std::vector<std::size_t>{dim / 2, dim} : std::vector<std::size_t>{dim}, 0.5f,
      {test::random_codebook(random,
                             dim % 3 == 0 ? 3
                             : dim > 1    ? 2
                                          : 1,
                             dim)},
      input));
}

void fill(PrototypeMap& map, std::size_t landmarks, std::int64_t step, bool positions) {
  test::Random random(7);
  std::vector<std::int64_t> ids;
  for (std::size_t i = 0; i < 3 * landmarks; ++i) {
    ids.push_back(static_cast<std::int64_t>(i % landmarks) * step);
  }
  const auto codes = random.integers<std::int8_t>(ids.size() * map.dim(), -127, 127);
  map.add_codes(ids, {codes.data(), ids.size(), map.dim()});
  if (!positions) return;
  constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
  for (const std::int64_t id : map.ids()) {
    const Position p =
        id == step ? Position{kNaN, kNaN, kNaN} : Position{5e5 + static_cast<double>(id), -2.5, 0};
    map.set_positions(std::span(&id, 1), std::span(&p, 1));
  }
}

// Journals of one commit, of several, and with a fold between.
void write_journals(const fs::path& folder) {
  const fs::path path = folder.parent_path() / "journal.pmk";
  int number = 0;
  for (const PrototypeMap& base : fuzz::journal_bases()) {
    base.save(path);
    PrototypeMap map = PrototypeMap::load(path, true);
    const auto keep = [&] {
      fs::copy(path.string() + ".journal", folder / std::to_string(number++));
    };
    keep();
    fuzz::observe(map, 2, 3);
    map.commit();
    keep();
    map.remove(std::vector{map.ids()[1]});
    map.set_positions(std::vector{map.ids()[0]}, std::vector{Position{1, 2, 3}});
    map.build_index({2});
    map.commit();
    keep();
    map.drop_index();
    fuzz::observe(map, 3, 1);
    map.commit();
    keep();
    map.close();
    fs::remove(path.string() + ".journal");
  }
  fs::remove(path);
}

}  // namespace

int main(int argc, char** argv) try {
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s FOLDER\n", argv[0]);
    return 2;
  }
  const fs::path folder = argv[1];
  for (const char* target : {"container", "encoder", "journal", "learning_map", "sealed_map"}) {
    fs::create_directories(folder / target);
  }
  const auto plain = small_encoder(4, 2), deep = small_encoder(9, 4), flat = small_encoder(1, 1);
  plain->save(folder / "encoder" / "plain");
  deep->save(folder / "encoder" / "deep");
  flat->save(folder / "encoder" / "flat");
  small_encoder(4, 2, {InputKind::uint8, 0})->save(folder / "encoder" / "bytes");
  small_encoder(4, 2, {InputKind::float32, 30})->save(folder / "encoder" / "floats");

  int number = 0;
  for (const auto& encoder : {plain, deep, flat}) {
    for (const std::size_t appearance_bits : {0, 1, 3}) {
      if (appearance_bits > encoder->dim()) continue;
      for (const std::size_t landmarks : {0, 1, 5, 20}) {
        PrototypeMap map(encoder, 0, appearance_bits);
        const std::string name = std::to_string(number++);
        if (landmarks > 0) fill(map, landmarks, number % 2 == 0 ? 1 : 7, number % 3 == 0);
        if (number % 2 == 0) {
          map.set_metadata({{"created", "2026-11-23T03:39:41Z"}, {"frame", "ENU, metres"}});
        }
        map.save(folder / "learning_map" / name);
        map.seal(folder / "sealed_map" / name);
        map.seal(folder / "sealed_map" / (name + ".16"), {.position_bits = 16});
        map.seal(folder / "sealed_map" / (name + ".words"), test::in_words(map));
        map.seal(folder / "sealed_map" / (name + ".merged"), test::in_words(map, 1.5));
        if (landmarks == 0) continue;
        map.build_index({std::min<std::size_t>(landmarks, 4)});
        map.save(folder / "learning_map" / (name + ".index"));
        map.seal(folder / "sealed_map" / (name + ".index"));
        map.seal(folder / "sealed_map" / (name + ".words.index"), test::in_words(map));
      }
    }
  }
  write_journals(folder / "journal");
  fs::copy(folder / "encoder" / "plain", folder / "container" / "encoder");
  fs::copy(folder / "learning_map" / "2", folder / "container" / "learning");
  fs::copy(folder / "sealed_map" / "2", folder / "container" / "sealed");
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "error: %s\n", error.what());
  return 1;
}
