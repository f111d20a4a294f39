// Adding in chunks and pieces, by several threads and out of memory, gives the map of one
// observation after the other.
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <numeric>
#include <thread>

#include "check.h"
#include "counted_memory.h"
#include "map/map_state.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

// More than two chunks of encoding (8192) and one piece of a change (2048).
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

  // Of landmarks `first` to `last`; runs of one landmark are long enough to halve its count.
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
    return encoder.encode({descriptors.data(), ids.size(), kBytes}).data;
  }
};

// Existing, new and repeated landmarks in one batch.
void test_threads(std::size_t appearance_bits, std::size_t dim, std::size_t nlist) {
  const auto encoder = test::random_encoder(64, dim);
  const Observations first(1, 3000, 0, 999), more(2, kMany, 500, 2499);
  const auto begun = [&] {
    PrototypeMap map(encoder, dim, appearance_bits);
    first.add_to(map, 0, first.ids.size(), 1);
    if (nlist != 0) map.build_index({.nlist = nlist});
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

auto distances(const PrototypeMap& map, Codes queries) {
  return map.search_codes(queries, 1).distances;
}

// Whichever allocation fails, the map holds each observation or not, and its rounded prototypes,
// which search reads, follow from its sums, which a file has.
void test_failures(std::size_t appearance_bits, std::size_t nlist, int threads) {
  const auto encoder = test::random_encoder();
  const Observations first(3, 500, 0, 99), more(4, kMany, 50, 2499);
  const std::vector<std::int8_t> codes = first.codes(*encoder);
  const Codes queries{codes.data(), 100, encoder->dim()};
  int failed = 0;
  bool done = false;
  for (long allowed = 0; !done; allowed += 1 + allowed / 8) {
    PrototypeMap map(encoder, 0, appearance_bits);
    first.add_to(map, 0, first.ids.size(), 1);
    if (nlist != 0) map.build_index({.nlist = nlist});
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
    map.remove(ids);
    CHECK(map.size() == 0 && map.prototype_count() == 0);
  }
  CHECK(failed > 10);
}

// A caller that writes over ids and codes meanwhile gets an error or other landmarks, but a valid
// map.
void test_races(std::size_t appearance_bits) {
  const auto encoder = test::random_encoder();
  const std::size_t dim = encoder->dim();
  int refused = 0;
  for (int round = 0; round < 20; ++round) {
    PrototypeMap map(encoder, 0, appearance_bits);
    std::vector<std::int64_t> ids(kMany, 3);
    std::vector<std::int8_t> codes(kMany * dim, 5);
    {
      const std::jthread adder([&] {
        try {
          map.add_codes(ids, {codes.data(), kMany, dim});
        } catch (const std::invalid_argument&) {
          ++refused;
        }
      });
      while (map.size() == 0) std::this_thread::yield();
      auto* id = &ids.back();
      auto* number = &codes.back();
      __atomic_store_n(round % 2 == 0 ? id : &ids[kMany / 2], -5, __ATOMIC_RELAXED);
      __atomic_store_n(round % 3 == 0 ? number : &codes[kMany / 2 * dim], -128, __ATOMIC_RELAXED);
    }
    CHECK(!bytes_of(map).empty() && PrototypeMap::load(path).size() == map.size());
  }
  std::printf("%d of 20 refused\n", refused);
}

// The same while landmarks are merged and get positions.
void test_later_races(std::size_t appearance_bits) {
  const auto encoder = test::random_encoder();
  for (int round = 0; round < 10; ++round) {
    PrototypeMap map(encoder, 0, appearance_bits);
    std::vector<std::int64_t> into(kMany), source(kMany);
    std::iota(into.begin(), into.end(), 0);
    std::iota(source.begin(), source.end(), kMany);
    const std::vector<std::int8_t> codes(kMany * encoder->dim(), 5);
    const Codes all{codes.data(), kMany, encoder->dim()};
    map.add_codes(into, all);
    map.add_codes(source, all);
    std::vector<Position> positions(kMany, Position{1, 2, 3});
    map.set_positions(std::vector<std::int64_t>{0}, {positions.data(), 1});
    {
      const std::jthread merger([&] {
        try {
          map.merge_landmarks(into, source);
        } catch (const std::out_of_range&) {
        } catch (const std::invalid_argument&) {
        }
      });
      while (map.size() == 2 * kMany) std::this_thread::yield();
      __atomic_store_n(&into.back(), -5, __ATOMIC_RELAXED);
    }
    into.back() = kMany - 1;
    {
      const std::jthread setter([&] {
        try {
          map.set_positions(into, positions);
        } catch (const std::invalid_argument&) {
        }
      });
      const std::vector<std::int64_t> first{1};
      while (!(map.positions(first)[0][0] == 1)) std::this_thread::yield();
      const double infinite = std::numeric_limits<double>::infinity();
      __atomic_store(&positions.back()[1], &infinite, __ATOMIC_RELAXED);
    }
    CHECK(!bytes_of(map).empty() && PrototypeMap::load(path).size() == map.size());
  }
}

// A landmark with as many appearances as there are. The test counts rows, not time.
void test_all_appearances() {
  constexpr std::size_t kDim = 16, kRows = 1 << kDim;
  std::vector<std::int8_t> codes;
  for (std::size_t i = 0; i < kRows * kDim; ++i) {
    codes.push_back((i / kDim >> i % kDim & 1) != 0 ? 5 : -5);
  }
  MapState state(test::random_encoder(64, kDim), kDim, kDim);
  const PrototypeStore& store = state.store;
  const std::vector<std::int64_t> ids(kRows, 7);
  for (const std::uint32_t times : {1, 2}) {
    MapChange(state).add(ids, {codes.data(), kRows, kDim}, 1);
    CHECK(store.prototype_count() == kRows && store.observations(store.at(7)) == times * kRows);
  }
  CHECK(store.steps() < 2 * kRows * MapChange::kPiece);
  PrototypeStore merged(kDim, kDim);
  for (int times = 0; times < 2; ++times) merged.merge(3, store, store.at(7));
  CHECK(merged.prototype_count() == kRows && merged.steps() < kRows);
}

}  // namespace

int main() {
  for (const std::size_t appearance_bits : {0, 3}) {
    for (const std::size_t nlist : {0, 7}) {
      for (const std::size_t dim : {12, 32, 34}) test_threads(appearance_bits, dim, nlist);
      for (const int threads : {1, 2}) test_failures(appearance_bits, nlist, threads);
    }
#ifndef __SANITIZE_THREAD__  // which is right to complain
    test_races(appearance_bits);
    test_later_races(appearance_bits);
#endif
  }
  fs::remove(path);
  test_all_appearances();
  return check::result();
}
