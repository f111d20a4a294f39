#include "protomark/protomark.h"

#include <algorithm>
#include <bit>

#include "check.h"
#include "random.h"

using namespace protomark;

int main() {
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
