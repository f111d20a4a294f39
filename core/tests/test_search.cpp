// Exact search and Hamming search against their definitions.
#include "protomark/protomark.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <map>

#include "base/sq4.h"
#include "check.h"
#include "random.h"

using namespace protomark;

namespace {

// Pairs of distance and id, nearest first: of several rows of a landmark the nearest.
template <typename Distance>
std::vector<std::pair<std::int64_t, std::int64_t>> ranking(std::size_t rows,
                                                           const std::int64_t* ids,
                                                           const Distance& distance) {
  std::map<std::int64_t, std::int64_t> nearest;
  for (std::size_t r = 0; r < rows; ++r) {
    const std::int64_t d = distance(r);
    const auto [at, is_new] = nearest.emplace(ids[r], d);
    if (!is_new) at->second = std::min(at->second, d);
  }
  std::vector<std::pair<std::int64_t, std::int64_t>> result;
  for (const auto& [id, d] : nearest) result.emplace_back(d, id);
  std::sort(result.begin(), result.end());
  return result;
}

struct Map {
  std::size_t rows;
  std::size_t dim;
  std::vector<std::int8_t> codes;          // rows x dim
  std::vector<std::int64_t> landmark_ids;  // of each landmark
  std::vector<std::uint32_t> of_row;
  std::vector<std::uint8_t> rows_of;
  std::vector<std::int64_t> row_ids;
};

// Few values give many ties. Ids do not ascend; with looks a landmark has 1 to 5 rows.
Map random_map(test::Random& random, std::size_t rows, std::size_t dim, bool looks, int span) {
  Map map{rows, dim, random.integers<std::int8_t>(rows * dim, -span, span), {}, {}, {}, {}};
  while (map.of_row.size() < rows) {
    const auto landmark = static_cast<std::uint32_t>(map.rows_of.size());
    const auto left = static_cast<std::int64_t>(rows - map.of_row.size());
    const auto n = looks ? random.integer(1, std::min<std::int64_t>(5, left)) : 1;
    map.rows_of.push_back(static_cast<std::uint8_t>(n));
    map.of_row.insert(map.of_row.end(), static_cast<std::size_t>(n), landmark);
    map.landmark_ids.push_back(static_cast<std::int64_t>((landmark * 7919u) % 1000003u));
  }
  for (const std::uint32_t landmark : map.of_row) {
    map.row_ids.push_back(map.landmark_ids[landmark]);
  }
  return map;
}

template <typename Prototypes>
void check_search(const Map& map, const Prototypes& prototypes, Codes queries, std::size_t k,
                  const SearchOptions& options) {
  std::vector<std::int64_t> ids(queries.rows * k, 12345);
  std::vector<float> distances(queries.rows * k, -1);
  search(prototypes, queries, options, {ids.data(), queries.rows, k},
         {distances.data(), queries.rows, k});
  int wrong = 0;
  for (std::size_t q = 0; q < queries.rows; ++q) {
    auto expected = ranking(map.rows, map.row_ids.data(), [&](std::size_t r) {
      std::int64_t sum = 0;
      for (std::size_t d = 0; d < map.dim; ++d) {
        const std::int64_t difference = map.codes[r * map.dim + d] - queries.row(q)[d];
        sum += difference * difference;
      }
      return sum;
    });
    if (options.ratio && expected.size() > 1 &&
        static_cast<double>(expected[0].first) >= static_cast<double>(*options.ratio) *
                                                      *options.ratio *
                                                      static_cast<double>(expected[1].first)) {
      expected.clear();
    }
    for (std::size_t j = 0; j < k; ++j) {
      const bool is_there = j < expected.size() && (!options.max_distance ||
                                                    static_cast<double>(expected[j].first) <=
                                                        static_cast<double>(*options.max_distance) *
                                                            *options.max_distance);
      const float distance = is_there ? std::sqrt(static_cast<float>(expected[j].first))
                                      : std::numeric_limits<float>::infinity();
      wrong += ids[q * k + j] != (is_there ? expected[j].second : -1);
      wrong += distances[q * k + j] != distance;
    }
  }
  CHECK(wrong == 0);
}

void check_codes(test::Random& random, std::size_t rows, std::size_t dim, std::size_t n, int span) {
  for (const bool looks : {false, true}) {
    Map map = random_map(random, rows, dim, looks, span);
    std::vector<std::int8_t> packed(packed_size(rows, dim), 0);
    for (std::size_t i = 0; i < rows * dim; ++i) {
      packed[packed_index(i / dim, i % dim, dim)] = map.codes[i];
    }
    PackedPrototypes prototypes{packed.data(), rows, dim, map.landmark_ids.data()};
    const auto queries = random.integers<std::int8_t>(n * dim, -span, span);
    for (int repeat = 0; repeat < 4; ++repeat) {
      prototypes.landmarks = {};
      if (looks && repeat % 2 == 0) prototypes.landmarks.of_row = map.of_row.data();
      if (looks && repeat % 2 == 1) prototypes.landmarks.rows_of = map.rows_of.data();
      SearchOptions options;
      options.threads = repeat + 1;
      if (random.integer(0, 2) == 0) {
        options.max_distance = static_cast<float>(random.integer(0, span * 2)) *
                               std::sqrt(static_cast<float>(dim) / 2);
      }
      if (random.integer(0, 2) == 0) options.ratio = 0.9f;
      const auto k = static_cast<std::size_t>(random.integer(1, 4));
      check_search(map, prototypes, {queries.data(), n, dim}, k, options);
    }
  }
}

// Rows for which fewer dimensions are compared first. These tell much, nothing, or as much as all.
template <std::size_t kRows, std::size_t kQueries>
void check_heads(test::Random& random) {
  constexpr std::size_t kDim = 32;
  for (const auto& [head, tail] : {std::pair(100, 10), {0, 100}, {3, 3}}) {
    const auto value = [&](std::size_t i) {
      const int span = i % kDim < kDim / 2 ? head : tail;
      return static_cast<std::int8_t>(random.integer(-span, span));
    };
    std::vector<std::int8_t> codes(kRows * kDim), queries(kQueries * kDim);
    for (std::size_t i = 0; i < codes.size(); ++i) codes[i] = value(i);
    for (std::size_t i = 0; i < queries.size(); ++i) queries[i] = value(i);
    std::vector<std::int8_t> packed(packed_size(kRows, kDim), 0);
    for (std::size_t i = 0; i < codes.size(); ++i) {
      packed[packed_index(i / kDim, i % kDim, kDim)] = codes[i];
    }
    std::vector<std::int64_t> ids(2 * kQueries);
    std::vector<float> distances(2 * kQueries);
    search(PackedPrototypes{packed.data(), kRows, kDim}, {queries.data(), kQueries, kDim}, {},
           {ids.data(), kQueries, 2}, {distances.data(), kQueries, 2});
    for (std::size_t q = 0; q < kQueries; ++q) {
      std::vector<std::pair<int, std::int64_t>> expected;
      for (std::size_t r = 0; r < kRows; ++r) {
        int sum = 0;
        for (std::size_t d = 0; d < kDim; ++d) {
          const int difference = codes[r * kDim + d] - queries[q * kDim + d];
          sum += difference * difference;
        }
        expected.emplace_back(sum, static_cast<std::int64_t>(r));
      }
      std::partial_sort(expected.begin(), expected.begin() + 2, expected.end());
      for (std::size_t j = 0; j < 2; ++j) {
        CHECK(ids[2 * q + j] == expected[j].second);
        CHECK(distances[2 * q + j] == std::sqrt(static_cast<float>(expected[j].first)));
      }
    }
  }
}

void check_codes4(test::Random& random, std::size_t rows, std::size_t dim, std::size_t n) {
  Map map = random_map(random, rows, dim, true, 127);
  const int half_step = static_cast<int>(random.integer(1, kMaxHalfStep));
  std::vector<std::uint8_t> packed(packed4_size(rows, dim), 0);
  for (std::size_t i = 0; i < rows * dim; ++i) {
    const std::uint8_t u = sq4_quantize(map.codes[i], half_step);
    map.codes[i] = static_cast<std::int8_t>(sq4_level(u, half_step));
    const std::size_t d = i % dim;
    packed[packed4_index(i / dim, d, dim)] |=
        static_cast<std::uint8_t>(packed4_high(d) ? u << 4 : u);
  }
  PackedPrototypes4 prototypes{packed.data(), rows, dim, half_step, map.landmark_ids.data()};
  prototypes.landmarks.rows_of = map.rows_of.data();
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
  std::vector<std::int64_t> numbers(rows), landmarks(rows);
  for (std::size_t r = 0; r < rows; ++r) {
    numbers[r] = static_cast<std::int64_t>(r);
    landmarks[r] = random.integer(0, static_cast<std::int64_t>(rows));
  }
  const auto none = static_cast<std::int32_t>(8 * bytes + 1);
  for (int threads = 1; threads <= 4; ++threads) {
    const auto k = static_cast<std::size_t>(random.integer(1, 4));
    HammingOptions options;
    options.threads = threads;
    if (threads % 2 == 0) options.max_distance = static_cast<std::int32_t>(bytes);
    const std::int32_t limit = options.max_distance.value_or(none - 1);
    for (const bool looks : {false, true}) {
      std::vector<std::int64_t> ids(n * k, 12345);
      std::vector<std::int32_t> distances(n * k, -1);
      const MatrixView<std::int64_t> ids_view{ids.data(), n, k};
      const MatrixView<std::int32_t> distances_view{distances.data(), n, k};
      const Descriptors all{database.data(), rows, bytes}, some{queries.data(), n, bytes};
      if (looks) {
        hamming_search(some, all, landmarks, options, ids_view, distances_view);
      } else {
        hamming_search(some, all, options, ids_view, distances_view);
      }
      int wrong = 0;
      for (std::size_t q = 0; q < n; ++q) {
        const auto expected =
            ranking(rows, looks ? landmarks.data() : numbers.data(), [&](std::size_t r) {
              std::int64_t sum = 0;
              for (std::size_t b = 0; b < bytes; ++b) {
                sum += std::popcount(
                    static_cast<unsigned>(database[r * bytes + b] ^ queries[q * bytes + b]));
              }
              return sum;
            });
        for (std::size_t j = 0; j < k; ++j) {
          const bool is_there = j < expected.size() && expected[j].first <= limit;
          wrong += ids[q * k + j] != (is_there ? expected[j].second : -1);
          wrong += distances[q * k + j] != (is_there ? expected[j].first : none);
        }
      }
      CHECK(wrong == 0);
    }
  }
}

}  // namespace

int main() {
  test::Random random(11);
  for (const std::size_t rows : {0, 1, 15, 17, 700}) {
    for (const std::size_t n : {0, 1, 3, 16, 21}) {
      for (const std::size_t dim : {1, 12, 32, 65}) check_codes(random, rows, dim, n, 3);
      for (const std::size_t bytes : {1, 32, 61}) check_hamming(random, rows, bytes, n);
      check_codes4(random, rows, 19, n);
    }
  }
  // Rows are divided among threads, and queries as well.
  check_codes(random, 9000, 8, 2, 2);
  check_codes(random, 900, 8, 150, 127);
  check_codes4(random, 9000, 9, 3);
  check_hamming(random, 9000, 9, 3);
  check_hamming(random, 900, 8, 150);
  check_heads<270'000, 7>(random);
  check_heads<5'000, 300>(random);
  // The largest distances.
  check_codes(random, 50, 256, 20, 127);
  const std::vector<std::int8_t> low(packed_size(1, 256), -127), high(256, 127);
  std::int64_t id = -1;
  float distance = 0;
  search(PackedPrototypes{low.data(), 1, 256}, {high.data(), 1, 256}, {}, {&id, 1, 1},
         {&distance, 1, 1});
  CHECK(id == 0 && distance == 254 * 16);
  return check::result();
}
