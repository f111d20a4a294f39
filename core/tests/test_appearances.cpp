#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <thread>

#include "check.h"
#include "protomark/protomark.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 12;
using Rows = std::vector<std::vector<float>>;

Rows rows_of(const Matrix<float>& matrix) {
  Rows rows;
  for (std::size_t i = 0; i < matrix.rows; ++i) {
    rows.emplace_back(matrix.row(i), matrix.row(i) + matrix.columns);
  }
  return rows;
}

// The k nearest landmarks by definition: each is as far away as its nearest prototype.
std::vector<std::int64_t> nearest(const std::map<std::int64_t, Rows>& map, const std::int8_t* query,
                                  std::size_t k) {
  std::vector<std::pair<std::int64_t, std::int64_t>> all;  // squared distance, id
  for (const auto& [id, rows] : map) {
    std::int64_t least = INT64_MAX;
    for (const auto& row : rows) {
      std::int64_t squared = 0;
      for (std::size_t d = 0; d < kDim; ++d) {
        const auto difference = static_cast<std::int64_t>(std::lround(row[d])) - query[d];
        squared += difference * difference;
      }
      least = std::min(least, squared);
    }
    all.emplace_back(least, id);
  }
  std::sort(all.begin(), all.end());
  std::vector<std::int64_t> ids;
  for (std::size_t i = 0; i < k; ++i) ids.push_back(i < all.size() ? all[i].second : -1);
  return ids;
}

template <typename Map>
void check_search(const Map& map, const std::map<std::int64_t, Rows>& rows, Codes queries) {
  const std::size_t k = 3;
  SearchOptions options;
  options.threads = 2;
  const Matches matches = map.search_codes(queries, k, options);
  for (std::size_t q = 0; q < queries.rows; ++q) {
    const std::vector<std::int64_t> found(matches.ids.row(q), matches.ids.row(q) + k);
    CHECK(found == nearest(rows, queries.row(q), k));
  }
}

}  // namespace

int main() {
  const fs::path folder =
      fs::temp_directory_path() / ("protomark_looks_" + std::to_string(::getpid()));
  fs::create_directory(folder);
  const auto encoder = test::random_encoder();
  const std::size_t n = 4000;
  test::Random random(9);
  const auto ids = random.integers<std::int64_t>(n, 0, 299);
  const auto codes = random.integers<std::int8_t>(n * kDim, -127, 127);
  const Codes all{codes.data(), n, kDim}, queries{codes.data(), 60, kDim};

  // The signs of a code tell its appearance, which has the mean of its codes.
  PrototypeMap map(encoder, 0, 4);
  map.add_codes(ids, all);
  std::map<std::int64_t, std::map<int, std::array<int, kDim + 1>>> expected;
  for (std::size_t i = 0; i < n; ++i) {
    int signs = 0;
    for (int j = 0; j < 4; ++j) signs |= (all.row(i)[j] > 0 ? 1 : 0) << j;
    auto& row = expected[ids[i]][signs];
    for (std::size_t d = 0; d < kDim; ++d) row[d] += all.row(i)[d];
    ++row[kDim];
  }
  std::size_t prototypes = 0;
  std::map<std::int64_t, Rows> means;
  for (const auto& [id, rows] : expected) {
    const Rows appearances = rows_of(map.appearances(id));
    const auto counts = map.appearance_counts(id);
    CHECK(appearances.size() == rows.size() && counts.size() == rows.size());
    prototypes += rows.size();
    std::size_t r = 0;
    for (const auto& [signs, row] : rows) {
      CHECK(static_cast<int>(counts[r]) == row[kDim]);
      for (std::size_t d = 0; d < kDim; ++d) {
        CHECK(appearances[r][d] == static_cast<float>(row[d]) / static_cast<float>(row[kDim]));
      }
      means[id].push_back(appearances[r++]);
    }
  }
  CHECK(map.size() == expected.size() && map.prototype_count() == prototypes);
  check_search(map, means, queries);

  // Added from several threads, and subtracted again.
  PrototypeMap shared(encoder, 0, 4);
  {
    std::vector<std::jthread> threads;
    for (std::size_t t = 0; t < 4; ++t) {
      threads.emplace_back([&, t] {
        for (std::size_t i = t; i < n; i += 4) {
          shared.add_codes(std::span(&ids[i], 1), {all.row(i), 1, kDim});
        }
      });
    }
  }
  for (const auto& [id, rows] : means) {
    CHECK(rows_of(shared.appearances(id)) == rows);
  }
  shared.subtract_codes(ids, all);
  CHECK(shared.size() == 0 && shared.prototype_count() == 0);

  // Sealed with all appearances, and with fewer.
  map.seal(folder / "all.pmk");
  const SealedMap sealed(folder / "all.pmk");
  CHECK(sealed.size() == map.size() && sealed.prototype_count() == prototypes);
  CHECK(sealed.ids() == map.ids());
  check_search(sealed, means, queries);
  map.seal(folder / "merged.pmk", test::in_words(map, 2.25));
  verify_file(folder / "merged.pmk");
  const SealedMap merged(folder / "merged.pmk");
  CHECK(merged.prototype_count() == map.size() * 9 / 4);
  CHECK(merged.bytes_per_landmark() == 2.25 * 6 + 1);
  std::map<std::int64_t, Rows> rows;
  for (const std::int64_t id : merged.ids()) rows[id] = rows_of(merged.appearances(id));
  check_search(merged, rows, queries);

  map.save(folder / "open.pmk");
  check_search(PrototypeMap::load(folder / "open.pmk"), means, queries);
  CHECK(PrototypeMap::load(folder / "open.pmk").appearance_bits() == 4);
  CHECK(check::throws<std::invalid_argument>([&] { PrototypeMap(encoder, 0, 13); }, "0 to 12"));
  CHECK(check::throws<std::invalid_argument>([&] { map.merge_map(PrototypeMap(encoder)); },
                                             "4 and 0 appearance bits"));
  CHECK(check::throws<UnknownLandmark>([&] { sealed.appearances(300); }, "landmark 300"));
  fs::remove_all(folder);
  return check::result();
}
