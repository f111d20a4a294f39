// Compares the answers of a learning or sealed map with its prototypes, one by one.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "expect.h"
#include "protomark/protomark.h"
#include "random.h"

namespace protomark::fuzz {

inline std::vector<std::int64_t> first_ids(std::vector<std::int64_t> ids) {
  ids.resize(std::min<std::size_t>(ids.size(), 50));
  return ids;
}

// appearances(id) gives the prototypes of a landmark, rounded as search compares them. Answers are
// compared with these only if `exact`.
template <typename Map, typename Appearances>
void search_map(const Map& map, const Appearances& appearances, bool exact = true) {
  const std::size_t n = 3, dim = map.dim(), k = 2;
  test::Random random(5);
  auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  std::fill_n(codes.begin(), dim, std::int8_t{-127});
  const Codes queries{codes.data(), n, dim};
  SearchOptions options;
  options.ratio = 0.8;
  options.max_distance = 300 * 300;
  map.search_codes(queries, k, options);
  const auto all = map.ids();
  EXPECT(all.size() == map.size());
  if (map.nlist() != 0) {
    for (const bool by_recall : {false, true}) {
      SearchOptions approximate;
      if (by_recall) {
        approximate.recall = 0.9;
      } else {
        approximate.nprobe = 2;
      }
      for (const std::int64_t id : map.search_codes(queries, k, approximate).ids.data) {
        EXPECT(id == -1 || std::binary_search(all.begin(), all.end(), id));
      }
    }
    EXPECT(map.nprobe(0.5) <= map.nprobe(1.0) && map.nprobe(1.0) == map.nlist());
  }
  const auto [ids, distances] = map.search_codes(queries, k);
  if (!exact || all.size() > 300) return;
  for (std::size_t q = 0; q < n; ++q) {
    std::vector<std::pair<std::int64_t, std::int64_t>> found;  // squared distance, id
    for (const std::int64_t id : all) {
      auto least = std::numeric_limits<std::int64_t>::max();
      const Matrix<float> rows = appearances(id);
      for (std::size_t r = 0; r < rows.rows; ++r) {
        std::int64_t squared = 0;
        for (std::size_t d = 0; d < dim; ++d) {
          const auto difference = static_cast<std::int64_t>(rows.row(r)[d]) - queries.row(q)[d];
          squared += difference * difference;
        }
        least = std::min(least, squared);
      }
      found.emplace_back(least, id);
    }
    std::sort(found.begin(), found.end());
    for (std::size_t j = 0; j < k; ++j) {
      if (j >= found.size()) {
        EXPECT(ids.row(q)[j] == -1 && distances.row(q)[j] == INT32_MAX);
        continue;
      }
      EXPECT(ids.row(q)[j] == found[j].second);
      EXPECT(distances.row(q)[j] == found[j].first);
    }
  }
}

// The prototypes of a learning map's landmark, rounded as search compares them.
inline Matrix<float> rounded_appearances(const PrototypeMap& map, std::int64_t id) {
  Matrix<float> result = map.appearances(id);
  for (float& v : result.data) v = std::round(v);  // halves away from zero
  return result;
}

}  // namespace protomark::fuzz
