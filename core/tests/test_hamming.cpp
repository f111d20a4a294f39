#include "protomark/protomark.h"

#include <algorithm>
#include <bit>

#include "check.h"
#include "random.h"

using namespace protomark;

namespace {

template <typename F>
bool refused(const F& f, const std::string& message) {
  return check::throws<std::invalid_argument>(f, message);
}

using Ids = std::vector<std::int64_t>;

void test_limits() {
  const std::vector<std::uint8_t> rows(4 * 8);
  const Descriptors database{rows.data(), 4, 8}, queries{rows.data(), 2, 8};
  CHECK(refused([&] { hamming_search({rows.data(), 2, 0}, {rows.data(), 2, 0}); },
                "1 to 4096 bytes"));
  CHECK(refused([&] { hamming_search(queries, database, 0); }, "k must be at least 1"));
  HammingOptions options;
  options.max_distance = -1;
  CHECK(refused([&] { hamming_search(queries, database, 2, options); }, "max_distance"));
  const Ids three = {1, 2, 3}, negative = {1, 2, 3, -4}, repeated = {7, 7, 5, 7};
  CHECK(refused([&] { hamming_search(queries, database, 2, {.landmarks = three}); },
                "4 rows, landmarks has 3"));
  CHECK(
      refused([&] { hamming_search(queries, database, 2, {.landmarks = negative}); }, "negative"));
  CHECK(hamming_search(queries, database, 2, {.landmarks = repeated}).ids.data == Ids{5, 7, 5, 7});
  const Matches none = hamming_search(queries, {rows.data(), 0, 8});
  CHECK(none.ids.data == Ids{-1, -1, -1, -1} && none.distances.data[0] == INT32_MAX);
}

}  // namespace

int main() {
  test_limits();
  test::Random random(5);
  const std::size_t bytes = 61, n = 1500, q = 20, k = 3;
  const auto database = random.integers<std::uint8_t>(n * bytes, 0, 3);
  const auto queries = random.integers<std::uint8_t>(q * bytes, 0, 3);
  HammingOptions options;
  options.threads = 2;
  const auto [ids, distances] =
      hamming_search({queries.data(), q, bytes}, {database.data(), n, bytes}, k, options);
  for (std::size_t i = 0; i < q; ++i) {
    std::vector<std::pair<int, std::int64_t>> all;
    for (std::size_t j = 0; j < n; ++j) {
      int d = 0;
      for (std::size_t b = 0; b < bytes; ++b) {
        d += std::popcount(static_cast<unsigned>(queries[i * bytes + b] ^ database[j * bytes + b]));
      }
      all.emplace_back(d, static_cast<std::int64_t>(j));
    }
    std::sort(all.begin(), all.end());
    for (std::size_t j = 0; j < k; ++j) {
      CHECK(ids.row(i)[j] == all[j].second);
      CHECK(distances.row(i)[j] == all[j].first);
    }
  }
  CHECK(check::throws<std::invalid_argument>(
      [&] { hamming_search({queries.data(), q, 60}, {database.data(), n, bytes}); },
      "queries have 60 bytes"));
  return check::result();
}
