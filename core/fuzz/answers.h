// What an open or a sealed map answers, against its prototypes one by one.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "expect.h"
#include "protomark/search.h"
#include "random.h"

namespace protomark::fuzz {

inline std::vector<std::int64_t> first_ids(std::vector<std::int64_t> ids) {
  ids.resize(std::min<std::size_t>(ids.size(), 50));
  return ids;
}

// looks(id) gives the prototypes of a landmark, rounded as search compares them. Only where `exact`
// are answers compared with these.
template <typename Map, typename Looks>
void search_map(const Map& map, const Looks& looks, bool exact = true) {
  const std::size_t n = 3, dim = map.dim(), k = 2;
  test::Random random(5);
  auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  std::fill_n(codes.begin(), dim, std::int8_t{-127});
  const Codes queries{codes.data(), n, dim};
  std::vector<std::int64_t> ids(n * k);
  std::vector<std::int32_t> distances(n * k);
  SearchOptions options;
  options.ratio = 0.8;
  options.max_distance = 300 * 300;
  map.search_codes(queries, options, {ids.data(), n, k}, {distances.data(), n, k});
  const auto all = map.ids();
  EXPECT(all.size() == map.size());
  if (map.index_cells() != 0) {
    for (const bool by_recall : {false, true}) {
      SearchOptions some;
      if (by_recall) {
        some.recall = 0.9;
      } else {
        some.nprobe = 2;
      }
      map.search_codes(queries, some, {ids.data(), n, k}, {distances.data(), n, k});
      for (const std::int64_t id : ids) {
        EXPECT(id == -1 || std::binary_search(all.begin(), all.end(), id));
      }
    }
    EXPECT(map.probes(0.5) <= map.probes(1.0) && map.probes(1.0) == map.index_cells());
  }
  map.search_codes(queries, {}, {ids.data(), n, k}, {distances.data(), n, k});
  if (!exact || all.size() > 300) return;
  for (std::size_t q = 0; q < n; ++q) {
    std::vector<std::pair<std::int64_t, std::int64_t>> found;  // squared distance, id
    for (const std::int64_t id : all) {
      auto least = std::numeric_limits<std::int64_t>::max();
      for (const std::vector<float>& look : looks(id)) {
        std::int64_t squared = 0;
        for (std::size_t d = 0; d < dim; ++d) {
          const auto difference = static_cast<std::int64_t>(look[d]) - queries.row(q)[d];
          squared += difference * difference;
        }
        least = std::min(least, squared);
      }
      found.emplace_back(least, id);
    }
    std::sort(found.begin(), found.end());
    for (std::size_t j = 0; j < k; ++j) {
      if (j >= found.size()) {
        EXPECT(ids[q * k + j] == -1 && distances[q * k + j] == INT32_MAX);
        continue;
      }
      EXPECT(ids[q * k + j] == found[j].second);
      EXPECT(distances[q * k + j] == found[j].first);
    }
  }
}

}  // namespace protomark::fuzz
