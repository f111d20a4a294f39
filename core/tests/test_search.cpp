// Exact search and Hamming search against their definitions.
#include "protomark/search.h"

#include <algorithm>
#include <bit>
#include <map>

#include "check.h"
#include "encoder/codebooks.h"
#include "protomark/hamming.h"
#include "random.h"
#include "search/scan.h"

using namespace protomark;

namespace {

// Pairs of distance and id, nearest first: of several rows of a landmark the nearest.
using Ranking = std::vector<std::pair<std::int64_t, std::int64_t>>;

template <typename Distance>
Ranking ranking(std::size_t rows, const std::int64_t* ids, const Distance& distance) {
  std::map<std::int64_t, std::int64_t> nearest;
  for (std::size_t r = 0; r < rows; ++r) {
    const std::int64_t d = distance(r);
    const auto [at, is_new] = nearest.emplace(ids[r], d);
    if (!is_new) at->second = std::min(at->second, d);
  }
  Ranking result;
  for (const auto& [id, d] : nearest) result.emplace_back(d, id);
  std::sort(result.begin(), result.end());
  return result;
}

std::int64_t squared_distance(const std::int8_t* a, const std::int8_t* b, std::size_t dim) {
  std::int64_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
  return sum;
}

// Counts the neighbours of query q that differ from the expected ones, up to a distance.
int wrong(const Matches& matches, std::size_t q, const Ranking& expected, std::int64_t limit) {
  int count = 0;
  for (std::size_t j = 0; j < matches.ids.columns; ++j) {
    const bool is_there = j < expected.size() && expected[j].first <= limit;
    count += matches.ids.row(q)[j] != (is_there ? expected[j].second : -1);
    count += matches.distances.row(q)[j] != (is_there ? expected[j].first : INT32_MAX);
  }
  return count;
}

struct Map {
  std::size_t rows;
  std::size_t dim;
  std::vector<std::int8_t> codes;          // rows x dim
  std::vector<std::int64_t> landmark_ids;  // of each landmark
  std::vector<LandmarkIndex> of_row;
  std::vector<std::int64_t> row_ids;
};

// Few values give many ties. Ids do not ascend; with appearances a landmark has 1 to 5 rows.
Map random_map(test::Random& random, std::size_t rows, std::size_t dim, bool appearances,
               int span) {
  Map map{rows, dim, random.integers<std::int8_t>(rows * dim, -span, span), {}, {}, {}};
  while (map.of_row.size() < rows) {
    const auto landmark = static_cast<std::uint32_t>(map.landmark_ids.size());
    const auto left = static_cast<std::int64_t>(rows - map.of_row.size());
    const auto n = appearances ? random.integer(1, std::min<std::int64_t>(5, left)) : 1;
    map.of_row.insert(map.of_row.end(), static_cast<std::size_t>(n), LandmarkIndex{landmark});
    // The largest id of all is among them.
    map.landmark_ids.push_back(landmark == 7 ? INT64_MAX : landmark * 7919ll % 1000003ll);
  }
  for (const LandmarkIndex landmark : map.of_row) {
    map.row_ids.push_back(map.landmark_ids[landmark.value]);
  }
  return map;
}

void check_search(const Map& map, const PackedPrototypes& prototypes, Codes queries, std::size_t k,
                  const SearchOptions& options) {
  const Matches matches = search_exact(prototypes, queries, k, options);
  int differences = 0;
  for (std::size_t q = 0; q < queries.rows; ++q) {
    Ranking expected = ranking(map.rows, map.row_ids.data(), [&](std::size_t r) {
      return squared_distance(&map.codes[r * map.dim], queries.row(q), map.dim);
    });
    if (options.ratio && expected.size() > 1 &&
        !(static_cast<double>(expected[0].first) <
          *options.ratio * *options.ratio * static_cast<double>(expected[1].first))) {
      expected.clear();
    }
    differences += wrong(matches, q, expected, options.max_distance.value_or(INT32_MAX));
  }
  CHECK(differences == 0);
}

void check_codes(test::Random& random, std::size_t rows, std::size_t dim, std::size_t n, int span) {
  for (const bool appearances : {false, true}) {
    const Map map = random_map(random, rows, dim, appearances, span);
    const std::vector<CodeVector> packed = pack_codes({map.codes.data(), rows, dim});
    PackedPrototypes prototypes{packed.data(), rows, dim};
    const auto queries = random.integers<std::int8_t>(n * dim, -span, span);
    for (int repeat = 0; repeat < 6; ++repeat) {
      prototypes.landmarks = {};
      prototypes.landmarks.ids = map.landmark_ids.data();
      if (appearances && repeat % 2 == 0) prototypes.landmarks.of_row = map.of_row.data();
      if (appearances && repeat % 2 == 1) {
        prototypes.landmarks.look_up = [&](Row row) { return map.of_row[row.value]; };
      }
      SearchOptions options;
      options.threads = 1 + repeat % 4;
      // A neighbour at just this distance is reported.
      if (rows * n != 0 && random.integer(0, 2) == 0) {
        const auto q = static_cast<std::size_t>(random.integer(0, static_cast<int>(n) - 1));
        const auto r = static_cast<std::size_t>(random.integer(0, static_cast<int>(rows) - 1));
        options.max_distance = static_cast<std::int32_t>(
            squared_distance(&map.codes[r * dim], &queries[q * dim], dim) / random.integer(1, 2));
      }
      if (random.integer(0, 2) == 0) options.ratio = random.integer(0, 1) == 0 ? 0.9 : 0.5;
      const auto k = static_cast<std::size_t>(random.integer(1, 4));
      check_search(map, prototypes, {queries.data(), n, dim}, k, options);
    }
  }
}

// Rows that are compared over a prefix of the dimensions first, which distinguishes much, nothing,
// or as much as all.
template <std::size_t kRows, std::size_t kQueries>
void check_prefixes(test::Random& random) {
  constexpr std::size_t kDim = 32;
  for (const auto& spans : {std::pair(100, 10), {0, 100}, {3, 3}}) {
    const auto value = [&](std::size_t i) {
      const int span = i % kDim < kDim / 2 ? spans.first : spans.second;
      return static_cast<std::int8_t>(random.integer(-span, span));
    };
    std::vector<std::int8_t> codes(kRows * kDim), queries(kQueries * kDim);
    for (std::size_t i = 0; i < codes.size(); ++i) codes[i] = value(i);
    for (std::size_t i = 0; i < queries.size(); ++i) queries[i] = value(i);
    const std::vector<CodeVector> packed = pack_codes({codes.data(), kRows, kDim});
    const Matches matches =
        search_exact({packed.data(), kRows, kDim}, {queries.data(), kQueries, kDim}, 2, {});
    int differences = 0;
    for (std::size_t q = 0; q < kQueries; ++q) {
      Ranking expected;
      for (std::size_t r = 0; r < kRows; ++r) {
        expected.emplace_back(squared_distance(&codes[r * kDim], &queries[q * kDim], kDim),
                              static_cast<std::int64_t>(r));
      }
      std::partial_sort(expected.begin(), expected.begin() + 2, expected.end());
      differences += wrong(matches, q, expected, INT32_MAX);
    }
    CHECK(differences == 0);
  }
}

void check_words(test::Random& random, std::size_t rows, std::size_t width, std::size_t words,
                 std::size_t n) {
  const std::size_t dim = width * words;
  Map map = random_map(random, rows, dim, true, 127);
  const Codebook codebook = test::random_codebook(random, width, dim);
  auto packed = random.integers<std::uint8_t>(packed_size(rows, dim, width), 0, 255);
  for (std::size_t i = 0; i < rows * dim; ++i) {
    const std::size_t word = i % dim / width;
    map.codes[i] =
        codebook.words[(word * 256 + packed[word_index(i / dim, word, words)]) * width + i % width];
  }
  const std::vector<std::int8_t> table = decode_table(codebook, dim);
  PackedPrototypes prototypes{packed.data(), rows, dim, width, table.data()};
  prototypes.landmarks.ids = map.landmark_ids.data();
  prototypes.landmarks.of_row = map.of_row.data();
  const auto queries = random.integers<std::int8_t>(n * dim, -127, 127);
  for (int threads = 1; threads <= 4; ++threads) {
    SearchOptions options;
    options.threads = threads;
    check_search(map, prototypes, {queries.data(), n, dim}, 2, options);
  }
}

void check_hamming(test::Random& random, std::size_t rows, std::size_t bytes, std::size_t n) {
  // Few bits give many ties.
  auto database = random.integers<std::uint8_t>(rows * bytes, 0, 3);
  if (rows > 2) std::fill_n(database.begin(), bytes, std::uint8_t{255});
  const auto queries = random.integers<std::uint8_t>(n * bytes, 0, 3);
  std::vector<std::int64_t> row_ids(rows), landmarks(rows);
  for (std::size_t r = 0; r < rows; ++r) {
    row_ids[r] = static_cast<std::int64_t>(r);
    landmarks[r] = random.integer(0, static_cast<std::int64_t>(rows));
  }
  for (int threads = 1; threads <= 4; ++threads) {
    const auto k = static_cast<std::size_t>(random.integer(1, 4));
    HammingOptions options;
    options.threads = threads;
    if (threads % 2 == 0) options.max_distance = static_cast<std::int32_t>(bytes);
    for (const bool distinct : {false, true}) {
      const Descriptors all{database.data(), rows, bytes}, some{queries.data(), n, bytes};
      options.landmarks.reset();
      if (distinct) options.landmarks = landmarks;
      const Matches matches = hamming_search(some, all, k, options);
      int differences = 0;
      for (std::size_t q = 0; q < n; ++q) {
        const Ranking expected =
            ranking(rows, distinct ? landmarks.data() : row_ids.data(), [&](std::size_t r) {
              std::int64_t sum = 0;
              for (std::size_t b = 0; b < bytes; ++b) {
                sum += std::popcount(
                    static_cast<unsigned>(database[r * bytes + b] ^ queries[q * bytes + b]));
              }
              return sum;
            });
        differences += wrong(matches, q, expected, options.max_distance.value_or(INT32_MAX));
      }
      CHECK(differences == 0);
    }
  }
}

// Prototypes at squared distances of 16 and 25, whose roots have a ratio of 0.8, and 41.
void check_limits() {
  const std::vector<std::int8_t> codes = {4, 0, 0, 5, 5, 4}, query = {0, 0};
  const std::vector<CodeVector> packed = pack_codes({codes.data(), 3, 2});
  using Ids = std::vector<std::int64_t>;
  const auto ids = [&](std::optional<std::int32_t> max_distance, std::optional<double> ratio) {
    SearchOptions options;
    options.max_distance = max_distance;
    options.ratio = ratio;
    return search_exact({packed.data(), 3, 2}, {query.data(), 1, 2}, 3, options).ids.data;
  };
  CHECK(ids({}, {}) == Ids{0, 1, 2});
  CHECK(ids(25, {}) == Ids{0, 1, -1});
  CHECK(ids(24, {}) == Ids{0, -1, -1});
  CHECK(ids(15, {}) == Ids{-1, -1, -1});
  CHECK(ids(0, {}) == Ids{-1, -1, -1});
  CHECK(ids(INT32_MAX, {}) == Ids{0, 1, 2});
  CHECK(ids({}, 0.8125) == Ids{0, 1, 2});
  CHECK(ids({}, 0.75) == Ids{-1, -1, -1});
  // The second nearest landmark counts for the ratio though it is too far away to be reported.
  CHECK(ids(20, 0.8125) == Ids{0, -1, -1});
  CHECK(ids(20, 0.75) == Ids{-1, -1, -1});
}

}  // namespace

int main() {
  test::Random random(11);
  for (const std::size_t rows : {0, 1, 15, 17, 700}) {
    for (const std::size_t n : {0, 1, 3, 16, 21}) {
      for (const std::size_t dim : {1, 12, 32, 65}) check_codes(random, rows, dim, n, 3);
      for (const std::size_t bytes : {1, 32, 61}) check_hamming(random, rows, bytes, n);
      for (const std::size_t width : {1, 2, 3, 4}) check_words(random, rows, width, 5, n);
    }
  }
  // Rows are divided among threads, and queries as well.
  check_codes(random, 9000, 8, 2, 2);
  check_codes(random, 900, 8, 150, 127);
  check_words(random, 9000, 3, 3, 3);
  check_hamming(random, 9000, 9, 3);
  check_hamming(random, 900, 8, 150);
  check_prefixes<270'000, 7>(random);
  check_prefixes<5'000, 300>(random);
  check_limits();
  // The largest distances.
  check_codes(random, 50, 256, 20, 127);
  const std::vector<std::int8_t> low(packed_size(1, 256), -127), high(256, 127);
  const Matches matches = search_exact({low.data(), 1, 256}, {high.data(), 1, 256}, 1, {});
  CHECK(matches.ids.data[0] == 0 && matches.distances.data[0] == 254 * 254 * 256);
  return check::result();
}
