// Maps merged under other ids, and parts of maps, equal one map of all observations.
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <map>
#include <string>

#include "check.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 12;

fs::path file() {
  return fs::temp_directory_path() / ("protomark_parts_" + std::to_string(::getpid()) + ".pmk");
}

std::string bytes_of(const PrototypeMap& map) {
  map.save(file());
  std::ifstream in(file(), std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

struct Observations {
  std::vector<std::int64_t> ids;
  std::vector<std::int8_t> codes;
  Codes view() const { return {codes.data(), ids.size(), kDim}; }
};

Observations observations(test::Random& random, std::size_t n, std::int64_t last_id) {
  return {random.integers<std::int64_t>(n, 0, last_id),
          random.integers<std::int8_t>(n * kDim, -127, 127)};
}

void place(PrototypeMap& map, std::int64_t id, double where) {
  const Position position{where, where, where};
  map.set_positions(std::span(&id, 1), std::span(&position, 1));
}

// More landmarks than a piece of a change has.
void test_merge_under_other_ids(std::size_t appearance_bits, bool indexed) {
  test::Random random(11);
  const Observations own = observations(random, 9000, 3000);
  const Observations others = observations(random, 60000, 25000);
  const auto encoder = test::random_encoder();
  PrototypeMap map(encoder, kDim, appearance_bits), other(encoder, kDim, appearance_bits);
  map.add_codes(own.ids, own.view());
  other.add_codes(others.ids, others.view());
  if (indexed) map.build_index({20});

  // Every third landmark becomes another, several of them the same one.
  std::map<std::int64_t, std::int64_t> renamed;
  for (const std::int64_t id : other.ids()) {
    if (id % 3 == 0) renamed[id] = id % 5 == 0 ? 7 : 100000 + id / 6;
  }
  std::vector<std::int64_t> into, source;
  for (const auto& [theirs, ours] : renamed) {
    source.insert(source.begin(), theirs);
    into.insert(into.begin(), ours);
  }
  const std::string before = bytes_of(other);
  map.merge_map(other, into, source);
  CHECK(bytes_of(other) == before);

  PrototypeMap joint(encoder, kDim, appearance_bits);
  joint.add_codes(own.ids, own.view());
  Observations moved = others;
  for (std::int64_t& id : moved.ids) {
    if (const auto found = renamed.find(id); found != renamed.end()) id = found->second;
  }
  // Landmark 7 has many more observations than a prototype holds: left out, as order matters then.
  joint.add_codes(moved.ids, moved.view());
  map.drop_index();
  for (PrototypeMap* one : {&map, &joint}) {
    const std::int64_t many = 7;
    one->remove(std::span(&many, 1));
  }
  CHECK(bytes_of(map) == bytes_of(joint));
}

void test_positions_of_a_merge() {
  test::Random random(12);
  const auto encoder = test::random_encoder();
  const Observations some{{1, 2, 3, 4}, random.integers<std::int8_t>(4 * kDim, -127, 127)};
  PrototypeMap map(encoder), other(encoder);
  map.add_codes(some.ids, some.view());
  other.add_codes(some.ids, some.view());
  place(map, 1, 10);
  place(other, 4, 4);
  place(other, 3, 3);
  const std::vector<std::int64_t> into{2, 2, 1}, source{4, 3, 2};
  map.merge_map(other, into, source);
  const auto positions = map.positions(std::vector<std::int64_t>{1, 2, 3});
  CHECK(positions[0][0] == 10 && positions[1][0] == 3 && std::isnan(positions[2][0]));
}

void test_wrong_merges_change_nothing() {
  test::Random random(13);
  const auto encoder = test::random_encoder();
  const Observations some{{1, 2}, random.integers<std::int8_t>(2 * kDim, -127, 127)};
  PrototypeMap map(encoder), other(encoder);
  map.add_codes(some.ids, some.view());
  other.add_codes(some.ids, some.view());
  const std::string before = bytes_of(map);
  using Ids = std::vector<std::int64_t>;
  CHECK(check::throws<UnknownLandmark>([&] { map.merge_map(other, Ids{9, 9}, Ids{1, 3}); }));
  CHECK(check::throws<std::invalid_argument>([&] { map.merge_map(other, Ids{9, 9}, Ids{1, 1}); },
                                             "named twice"));
  CHECK(check::throws<std::invalid_argument>([&] { map.merge_map(other, Ids{-9}, Ids{1}); },
                                             "negative"));
  CHECK(check::throws<std::invalid_argument>([&] { map.merge_map(other, Ids{9}, Ids{}); },
                                             "1 landmark ids for 0 sources"));
  CHECK(bytes_of(map) == before);
}

void test_parts(std::size_t appearance_bits) {
  test::Random random(14);
  const auto encoder = test::random_encoder();
  const Observations some = observations(random, 2000, 300);
  PrototypeMap map(encoder, kDim, appearance_bits);
  map.add_codes(some.ids, some.view());
  const std::vector<std::int64_t> ids = map.ids();
  for (const std::int64_t id : ids) {
    if (id % 4 != 0) place(map, id, static_cast<double>(id % 9) - 4.5);
  }
  const std::string before = bytes_of(map);
  map.build_index({10});

  const std::vector<std::int64_t> boundaries{50, 50, 200};
  const std::vector<PrototypeMap> parts = map.split_by_id(boundaries);
  CHECK(parts.size() == 4 && parts[1].size() == 0);
  CHECK(parts[2].ids().front() >= 50 && parts[2].ids().back() < 200);
  CHECK(parts[0].nlist() == 0);
  PrototypeMap whole(encoder, kDim, appearance_bits);
  for (const PrototypeMap& part : parts) whole.merge_map(part);
  CHECK(bytes_of(whole) == before);

  const std::vector<MapPart> tiles = map.split_by_space(3.0);
  CHECK(tiles.size() == 5 && !tiles.back().cell);
  PrototypeMap again(encoder, kDim, appearance_bits);
  for (std::size_t i = 0; i < tiles.size(); ++i) {
    if (i + 1 < tiles.size()) CHECK(tiles[i].cell->at(2) == static_cast<std::int64_t>(i) - 2);
    again.merge_map(tiles[tiles.size() - 1 - i].map);
  }
  CHECK(bytes_of(again) == before);

  CHECK(check::throws<std::invalid_argument>(
      [&] { map.split_by_id(std::vector<std::int64_t>{3, 2}); }, "ascend"));
  for (const double size : {0.0, -1.0, std::numeric_limits<double>::infinity(),
                            std::numeric_limits<double>::quiet_NaN()}) {
    CHECK(check::throws<std::invalid_argument>([&] { map.split_by_space(size); },
                                               "above 0 and finite"));
  }
  place(map, ids[1], 1e300);
  CHECK(check::throws<std::invalid_argument>([&] { map.split_by_space(1.0); }, "too small"));
}

}  // namespace

int main() {
  for (const std::size_t appearance_bits : {0, 3}) {
    for (const bool indexed : {false, true}) test_merge_under_other_ids(appearance_bits, indexed);
    test_parts(appearance_bits);
  }
  test_positions_of_a_merge();
  test_wrong_merges_change_nothing();
  fs::remove(file());
  return check::result();
}
