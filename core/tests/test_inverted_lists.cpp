// Inverted lists: a search of all of them is exact after any history.
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <set>
#include <string>

#include "base/quantize.h"
#include "check.h"
#include "file/container.h"
#include "protomark/protomark.h"
#include "random.h"
#include "sealing.h"
#include "search/coarse_quantizer.h"
#include "search/inverted_lists.h"
#include "search/list_blocks.h"
#include "search/scan.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 12;

template <typename Map>
Matches search(const Map& map, Codes queries, std::size_t k, SearchOptions options = {}) {
  return map.search_codes(queries, k, options);
}

SearchOptions with_nprobe(std::size_t nprobe, int threads = 1) {
  SearchOptions options;
  options.nprobe = nprobe;
  options.threads = threads;
  return options;
}

SearchOptions with_recall(double recall) {
  SearchOptions options;
  options.recall = recall;
  return options;
}

// Codes in clumps, like real ones.
std::vector<std::int8_t> clumped(test::Random& random, std::size_t n, std::size_t dim = kDim) {
  std::vector<std::int8_t> result;
  for (std::size_t i = 0; i < n; ++i) {
    test::Random clump(static_cast<std::uint32_t>(random.integer(0, 19)));
    for (std::size_t d = 0; d < dim; ++d) {
      result.push_back(static_cast<std::int8_t>(clump.integer(-90, 90) + random.integer(-37, 37)));
    }
  }
  return result;
}

// The answers of a map by all exact searches.
template <typename Map>
void check_exact(const Map& map, const Matches& expected, Codes queries) {
  CHECK(search(map, queries, 3) == expected);
  for (const int threads : {1, 3}) {
    CHECK(search(map, queries, 3, with_nprobe(map.nlist(), threads)) == expected);
  }
  CHECK(search(map, queries, 3, with_recall(1)) == expected);
}

void list_blocks() {
  test::Random random(3);
  ListBlocks blocks(5);
  // The expected rows of each list in order, and the value of each row.
  std::map<std::uint32_t, std::vector<int>> expected;
  std::vector<int> stands;
  int next = 0;
  for (int step = 0; step < 4000; ++step) {
    const auto list = static_cast<std::uint32_t>(random.integer(0, 4));
    // Grows, then shrinks to nothing.
    if (random.integer(0, 99) < (step < 2000 ? 65 : 25)) {
      const Row row = blocks.append(list);
      stands.resize(blocks.blocks() * kPackedRows, -1);
      stands[row.value] = next;
      expected[list].push_back(next++);
    } else if (!expected[list].empty()) {
      const Row last = blocks.last(list);
      CHECK(stands[last.value] == expected[list].back());
      stands[last.value] = -1;
      expected[list].pop_back();
      const std::uint32_t emptied = blocks.pop(list);
      if (emptied != ListBlocks::kNone) {
        const std::size_t moved = blocks.blocks() * kPackedRows;
        std::copy_n(stands.begin() + static_cast<long>(moved), kPackedRows,
                    stands.begin() + emptied * kPackedRows);
        stands.resize(moved);
      }
    }
    if (step % 50 != 0) continue;
    std::size_t all = 0;
    const InvertedLists lists(blocks);
    for (std::uint32_t c = 0; c < 5; ++c) {
      std::vector<std::uint32_t> list_of_blocks;
      lists.read(c, list_of_blocks);
      CHECK(lists.rows(c) == expected[c].size());
      CHECK(list_of_blocks.size() == (expected[c].size() + kPackedRows - 1) / kPackedRows);
      for (std::uint32_t i = 0; i < expected[c].size(); ++i) {
        const Row row{list_of_blocks[i / kPackedRows] * 16 + i % 16};
        CHECK(stands[row.value] == expected[c][i]);
        CHECK(blocks.list_of(row) == c);
      }
      all += list_of_blocks.size();
    }
    CHECK(all == blocks.blocks());
  }
}

void means() {
  bool equal = true;
  for (int n = 1; n <= 255; ++n) {
    std::vector<std::int16_t> sums;
    for (int sum = -127 * n; sum <= 127 * n; ++sum) sums.push_back(static_cast<std::int16_t>(sum));
    std::vector<std::int8_t> found(sums.size());
    rounded_means(sums.data(), n, sums.size(), found.data());
    for (std::size_t i = 0; i < sums.size(); ++i) {
      equal = equal && found[i] == rounded_mean<int>(sums[i], n);
    }
  }
  CHECK(equal);
}

void learning() {
  test::Random random(5);
  const std::size_t n = 3000;
  const auto codes = clumped(random, n);
  const Codes view{codes.data(), n, kDim};
  const CoarseQuantizer quantizer = CoarseQuantizer::learn(view, 40, 1);
  CHECK(quantizer.nlist() == 40);
  CHECK(CoarseQuantizer::learn(view, 40, 3).centroids() == quantizer.centroids());
  const auto own = quantizer.assign(view, 1);
  CHECK(quantizer.assign(view, 4) == own);
  // A code alone has the list that it has among others.
  for (const std::size_t i : {0, 17, 2999})
    CHECK(quantizer.assign({view.row(i), 1, kDim}, 1)[0] == own[i]);
  // All lists are used, and nearly all codes are in that of the nearest centroid.
  CHECK(std::set(own.begin(), own.end()).size() == 40);
  const std::vector<std::int64_t> nearest = search_exact(quantizer.packed(), view, 1, {}).ids.data;
  std::size_t same = 0;
  for (std::size_t i = 0; i < n; ++i) same += nearest[i] == own[i] ? 1 : 0;
  CHECK(same > n * 98 / 100);
  // Equal codes, and as many lists as codes.
  const std::vector<std::int8_t> equal(50 * kDim, 7);
  const CoarseQuantizer alike = CoarseQuantizer::learn({equal.data(), 50, kDim}, 50, 1);
  CHECK(alike.nlist() == 50);
  CHECK(alike.assign({equal.data(), 50, kDim}, 1) == std::vector<std::uint32_t>(50, 0));
  CHECK(CoarseQuantizer::learn({codes.data(), 1, kDim}, 1, 1).assign(view, 1) ==
        std::vector<std::uint32_t>(n, 0));
  // Equal centroids cost nothing: comparing each code with all of these would take minutes.
  Matrix<std::int8_t> many(CoarseQuantizer::kMaxLists, kDim);
  std::ranges::fill(many.data, std::int8_t{7});
  std::ranges::copy(quantizer.centroids().data, many.data.begin());
  const auto lists = CoarseQuantizer(many).assign({many.data.data(), n * 20, kDim}, 1);
  CHECK(lists[39] == 39 && lists[40] == 40 && lists.back() == 40);
}

// The nearest lists against their definition: a few, many and all of them.
void nearest() {
  test::Random random(14);
  for (const std::size_t nlist : {1, 15, 300, 2000}) {
    const std::size_t n = nlist == 300 ? 600 : 40;
    const auto centroids = clumped(random, nlist), codes = clumped(random, n);
    const std::vector<CodeVector> packed = pack_codes({centroids.data(), nlist, kDim});
    const PreparedCodes queries(Codes{codes.data(), n, kDim});
    for (const std::size_t nprobe : {1, 3, 40, 300, 2000}) {
      if (nprobe > nlist) continue;
      const auto found = nearest_lists({packed.data(), nlist, kDim}, queries, nprobe, 2);
      bool right = true;
      for (std::size_t q = 0; q < n; ++q) {
        std::vector<std::pair<int, std::uint32_t>> expected;
        for (std::uint32_t c = 0; c < nlist; ++c) {
          int distance = 0;
          for (std::size_t d = 0; d < kDim; ++d) {
            const int difference = codes[q * kDim + d] - centroids[c * kDim + d];
            distance += difference * difference;
          }
          expected.emplace_back(distance, c);
        }
        std::sort(expected.begin(), expected.end());
        right = right && found[q * nprobe] == expected[0].second;
        std::set<std::uint32_t> lists;
        for (std::size_t p = 0; p < nprobe; ++p) lists.insert(expected[p].second);
        right = right && lists == std::set(&found[q * nprobe], &found[q * nprobe] + nprobe);
      }
      CHECK(right);
    }
  }
}

std::vector<std::byte> content(const fs::path& path) {
  const MappedFile file(path);
  return {file.bytes().begin(), file.bytes().end()};
}

// After any history a map with an index answers as one without.
void histories(std::size_t appearance_bits) {
  const auto encoder = test::random_encoder();
  test::Random random(6);
  PrototypeMap with(encoder, kDim, appearance_bits), without(encoder, kDim, appearance_bits);
  const auto codes = clumped(random, 64);
  const Codes queries{codes.data(), 64, kDim};
  struct Observation {
    std::int64_t id;
    std::vector<std::int8_t> code;
  };
  std::vector<Observation> added;
  const auto both = [&](const auto& change) {
    change(with);
    change(without);
  };
  const auto add = [&](std::size_t n, std::int64_t ids) {
    const auto landmarks = random.integers<std::int64_t>(n, 0, ids - 1);
    const auto more = clumped(random, n);
    both([&](PrototypeMap& map) { map.add_codes(landmarks, {more.data(), n, kDim}); });
    for (std::size_t i = 0; i < n; ++i) {
      added.push_back({landmarks[i], {&more[i * kDim], &more[i * kDim] + kDim}});
    }
  };
  add(500, 300);
  with.build_index({16});
  CHECK(with.nlist() == 16);
  for (int round = 0; round < 12; ++round) {
    add(400, 300 + 100 * round);
    // Subtracts observations, all those of a few landmarks among them.
    std::vector<std::int64_t> landmarks;
    std::vector<std::int8_t> taken;
    const std::int64_t removed = random.integer(0, 300);
    std::erase_if(added, [&](const Observation& o) {
      if (o.id % 40 != removed % 40 && random.integer(0, 9) != 0) return false;
      landmarks.push_back(o.id);
      taken.insert(taken.end(), o.code.begin(), o.code.end());
      return true;
    });
    both([&](PrototypeMap& map) {
      map.subtract_codes(landmarks, {taken.data(), landmarks.size(), kDim});
    });
    const auto ids = with.ids();
    CHECK(ids == without.ids());
    const std::vector<std::int64_t> discarded = {ids[5], ids[77]};
    both([&](PrototypeMap& map) { map.remove(discarded); });
    std::erase_if(
        added, [&](const Observation& o) { return o.id == discarded[0] || o.id == discarded[1]; });
    if (round % 3 == 1) {
      const std::vector<std::int64_t> into = {ids[1], ids[1]}, source = {ids[20], ids[30]};
      both([&](PrototypeMap& map) { map.merge_landmarks(into, source); });
      for (Observation& o : added) {
        if (o.id == ids[20] || o.id == ids[30]) o.id = ids[1];
      }
    }
    if (round % 4 == 2) {
      PrototypeMap other(encoder, kDim, appearance_bits);
      const auto more = clumped(random, 100);
      const auto those = random.integers<std::int64_t>(100, 200, 2000);
      other.add_codes(those, {more.data(), 100, kDim});
      if (round % 8 == 2) other.build_index({3});
      both([&](PrototypeMap& map) { map.merge_map(other); });
      for (std::size_t i = 0; i < 100; ++i) {
        added.push_back({those[i], {&more[i * kDim], &more[i * kDim] + kDim}});
      }
    }
    CHECK(with.prototype_count() == without.prototype_count());
    CHECK(with.counts(with.ids()) == without.counts(without.ids()));
    check_exact(with, search(without, queries, 3), queries);

    // Lists do not depend on the history: a map read from the file gives the same answers.
    const fs::path path =
        fs::temp_directory_path() / ("test_inverted_lists_" + std::to_string(::getpid()) + ".pmk");
    with.save(path);
    const PrototypeMap again = PrototypeMap::load(path);
    CHECK(again.nlist() == 16);
    CHECK(search(again, queries, 3, with_nprobe(2)) == search(with, queries, 3, with_nprobe(2)));
    const auto bytes = content(path);
    again.save(path);
    CHECK(content(path) == bytes);
    fs::remove(path);
    if (round == 6) {
      with.drop_index();
      CHECK(with.nlist() == 0);
      CHECK(search(with, queries, 3) == search(without, queries, 3));
      with.build_index({16}, 2);
    }
  }
  // To nothing and up again.
  both([&](PrototypeMap& map) { map.remove(map.ids()); });
  CHECK(search(with, queries, 2, with_nprobe(4)).ids.data == std::vector<std::int64_t>(128, -1));
  add(300, 100);
  check_exact(with, search(without, queries, 3), queries);
}

// Rows that move within the map get the indices that they get in a copy.
void ways(std::size_t appearance_bits, bool placed) {
  const auto encoder = test::random_encoder();
  const fs::path path =
      fs::temp_directory_path() / ("test_inverted_lists_" + std::to_string(::getpid()) + ".pmk");
  PrototypeMap beside(encoder, kDim, appearance_bits), within(encoder, kDim, appearance_bits);
  test::Random random(12);
  const auto codes = clumped(random, 64);
  const Codes queries{codes.data(), 64, kDim};
  const auto both = [&](const auto& change) {
    change(beside);
    change(within);
  };
  const auto add = [&](std::size_t n, std::int64_t first) {
    const auto landmarks = random.integers<std::int64_t>(n, first, first + 499);
    const auto more = clumped(random, n);
    both([&](PrototypeMap& map) { map.add_codes(landmarks, {more.data(), n, kDim}); });
    const std::vector<Position> positions(1, {1, 2, static_cast<double>(first)});
    const std::vector<std::int64_t> one = {landmarks[0]};
    if (placed) both([&](PrototypeMap& map) { map.set_positions(one, positions); });
  };
  const auto check_equal = [&] {
    CHECK(within.nlist() == beside.nlist());
    CHECK(within.prototype_count() == beside.prototype_count());
    const auto ids = within.ids();
    CHECK(ids == beside.ids());
    CHECK(within.counts(ids) == beside.counts(ids));
    CHECK(search(within, queries, 3) == search(beside, queries, 3));
    for (const std::size_t nprobe : {1, 3}) {
      if (within.nlist() == 0) continue;
      CHECK(search(within, queries, 3, with_nprobe(nprobe)) ==
            search(beside, queries, 3, with_nprobe(nprobe)));
      CHECK(search(within, queries, 3, with_recall(0.9)) ==
            search(beside, queries, 3, with_recall(0.9)));
    }
    beside.save(path);
    const auto saved = content(path);
    within.save(path);
    CHECK(content(path) == saved);
    beside.seal(path);
    const auto sealed = content(path);
    within.seal(path);
    CHECK(content(path) == sealed);
  };
  add(900, 0);
  // More lists, fewer, as many, one, and none in between.
  for (const std::size_t nlist : {7, 60, 60, 3, 1, 200}) {
    beside.build_index({nlist});
    within.build_index({nlist, true});
    check_equal();
    // With rows removed and others added.
    const auto ids = beside.ids();
    const std::vector<std::int64_t> removed(ids.begin() + 40, ids.begin() + 200);
    both([&](PrototypeMap& map) { map.remove(removed); });
    check_equal();
    add(300, static_cast<std::int64_t>(nlist) * 10);
    check_equal();
    if (nlist == 60) both([](PrototypeMap& map) { map.drop_index(); });
    check_equal();
  }
  both([](PrototypeMap& map) {
    auto ids = map.ids();
    ids.pop_back();
    map.remove(ids);
  });
  beside.build_index({1});
  within.build_index({1, true});
  check_equal();
  fs::remove(path);
}

std::vector<std::vector<float>> sorted_rows(const Matrix<float>& matrix) {
  std::vector<std::vector<float>> rows;
  for (std::size_t i = 0; i < matrix.rows; ++i) {
    rows.emplace_back(matrix.row(i), matrix.row(i) + matrix.columns);
  }
  std::ranges::sort(rows);
  return rows;
}

void sealed(std::size_t appearance_bits, bool in_words, std::optional<double> prototypes = {},
            std::size_t n = 5000) {
  const auto encoder = test::random_encoder();
  test::Random random(8);
  PrototypeMap with(encoder, kDim, appearance_bits), without(encoder, kDim, appearance_bits);
  const auto landmarks = random.integers<std::int64_t>(n, 0, static_cast<std::int64_t>(n / 10 * 3));
  const auto codes = clumped(random, n);
  for (PrototypeMap* map : {&with, &without}) map->add_codes(landmarks, {codes.data(), n, kDim});
  with.build_index({30});
  const fs::path path =
      fs::temp_directory_path() / ("test_inverted_lists_" + std::to_string(::getpid()) + ".pmk");
  const fs::path plain_path = path.string() + ".plain";
  const SealOptions seal = in_words ? test::in_words(with, prototypes) : SealOptions();
  with.seal(path, seal);
  without.seal(plain_path, seal);
  const SealedMap map(path), plain(plain_path);
  CHECK(map.nlist() == 30);
  CHECK(map.prototype_count() == plain.prototype_count());
  const Codes queries{codes.data(), 80, kDim};
  check_exact(map, search(plain, queries, 3), queries);
  CHECK(map.ids() == plain.ids());
  const auto ids = map.ids();
  CHECK(map.prototypes(ids) == plain.prototypes(ids));
  for (const std::int64_t id : {ids[0], ids[700], ids.back()}) {
    CHECK(sorted_rows(map.appearances(id)) == sorted_rows(plain.appearances(id)));
  }
  CHECK((map.words() != 0) == in_words);
  if (!in_words) {
    CHECK(map.nprobe(0.9) == with.nprobe(0.9));
    for (const SearchOptions& options : {with_recall(0.9), with_nprobe(3)}) {
      CHECK(search(map, queries, 2, options) == search(with, queries, 2, options));
    }
  }
  CHECK(fs::file_size(path) > fs::file_size(plain_path));
  CHECK(map.nprobe(0.5) <= map.nprobe(0.9));
  CHECK(map.nprobe(1) == 30);
  CHECK(check::throws<std::invalid_argument>([&] { plain.nprobe(0.9); }, "needs an index"));
  CHECK(check::throws<std::invalid_argument>([&] { search(plain, queries, 2, with_recall(0.9)); },
                                             "build_index before the map is sealed"));
  fs::remove(path);
  fs::remove(plain_path);
}

void errors() {
  const auto encoder = test::random_encoder();
  test::Random random(9);
  PrototypeMap map(encoder);
  CHECK(check::throws<std::invalid_argument>([&] { map.build_index(); }, "without landmarks"));
  const std::vector<std::int64_t> landmarks = {1, 2, 3};
  const auto codes = clumped(random, 3);
  const Codes queries{codes.data(), 3, kDim};
  map.add_codes(landmarks, queries);
  CHECK(
      check::throws<std::invalid_argument>([&] { map.build_index({4}); }, "nlist must be 1 to 3"));
  CHECK(
      check::throws<std::invalid_argument>([&] { map.build_index({0}); }, "nlist must be 1 to 3"));
  CHECK(check::throws<std::invalid_argument>([&] { map.build_index({2}, 0); }, "threads"));
  CHECK(check::throws<std::invalid_argument>([&] { map.nprobe(0.9); }, "build_index"));
  for (const SearchOptions& options : {with_recall(0.9), with_nprobe(2)}) {
    CHECK(check::throws<std::invalid_argument>([&] { search(map, queries, 1, options); },
                                               "needs an index: call build_index first"));
  }
  map.build_index({3});
  for (const double recall : {0.0, -1.0, 1.1, std::nan("")}) {
    CHECK(check::throws<std::invalid_argument>(
        [&] { search(map, queries, 1, with_recall(recall)); }, "recall must be above 0"));
  }
  CHECK(check::throws<std::invalid_argument>([&] { search(map, queries, 1, with_nprobe(0)); },
                                             "nprobe must be at least 1"));
  SearchOptions two = with_nprobe(1);
  two.recall = 0.9;
  CHECK(check::throws<std::invalid_argument>([&] { search(map, queries, 1, two); }, "exclude"));
  CHECK(search(map, queries, 1, with_nprobe(1000)).ids.data == landmarks);
  map.build_index();
  CHECK(map.nlist() == 1);
}

}  // namespace

int main() {
  list_blocks();
  means();
  learning();
  nearest();
  histories(0);
  histories(5);
  for (const std::size_t appearance_bits : {0, 5}) {
    for (const bool placed : {false, true}) ways(appearance_bits, placed);
  }
  for (const std::size_t appearance_bits : {0, 5}) {
    for (const bool in_words : {false, true}) sealed(appearance_bits, in_words);
  }
  sealed(5, true, 1.5);
  sealed(5, true, 2.0);
  // More than are sealed at a time.
  sealed(0, false, {}, 250'000);
  sealed(5, false, {}, 100'000);
  errors();
  return check::result();
}
