#include "search/recall.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace protomark {
namespace {

std::int32_t squared_distance(const std::int8_t* a, const std::int8_t* b, std::size_t dim) {
  std::int32_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
  return sum;
}

}  // namespace

std::vector<std::size_t> test_rows(std::size_t rows) {
  const std::size_t n = std::min(rows, kTestQueries);
  std::vector<std::size_t> result(n);
  // Multiples of the golden ratio are as even, and in no step with what cells are learned from.
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint64_t x = (i + 1) * std::uint64_t{0x9e3779b97f4a7c15};
    result[i] = static_cast<std::size_t>((x >> 32) * rows >> 32);
  }
  return result;
}

namespace {

// Codes as far from these as observations are from the prototypes of their landmarks: the
// difference of two others has twice the variance of all, 0.4 of it 0.32 times; observations of the
// encoders that ship have 0.2 to 0.5 times.
std::vector<std::int8_t> like_observations(Codes codes) {
  std::vector<std::int8_t> result(codes.rows * codes.columns);
  for (std::size_t i = 0; i < codes.rows; ++i) {
    const std::int8_t* a = codes.row((i + 1) % codes.rows);
    const std::int8_t* b = codes.row((i + 2) % codes.rows);
    for (std::size_t d = 0; d < codes.columns; ++d) {
      const int moved = codes.row(i)[d] + 2 * (a[d] - b[d]) / 5;
      result[i * codes.columns + d] = static_cast<std::int8_t>(std::clamp(moved, -127, 127));
    }
  }
  return result;
}

// own(q): the landmark that is not to be found.
ProbeRanks ranks_of(Codes queries, const std::function<std::int64_t(std::size_t)>& own,
                    const std::vector<std::int8_t>& centroids, const SearchTwo& search_two,
                    const CellOf& cell_of) {
  const std::size_t n = queries.rows, dim = queries.columns, cells = centroids.size() / dim;
  std::vector<std::int64_t> ids(2 * n);
  std::vector<float> distances(2 * n);
  search_two(queries, {ids.data(), n, 2}, {distances.data(), n, 2});
  ProbeRanks ranks;
  for (std::size_t q = 0; q < n; ++q) {
    // Where others are as near, the own landmark need not be the first, or among the two.
    const std::int64_t nearest = ids[2 * q] == own(q) ? ids[2 * q + 1] : ids[2 * q];
    if (nearest < 0) continue;
    const std::int8_t* query = queries.row(q);
    const std::uint32_t cell = cell_of(nearest, query);
    const std::int32_t limit = squared_distance(query, &centroids[cell * dim], dim);
    std::uint32_t rank = 1;
    for (std::uint32_t c = 0; c < cells; ++c) {
      const std::int32_t distance = squared_distance(query, &centroids[c * dim], dim);
      if (distance < limit || (distance == limit && c < cell)) ++rank;
    }
    ranks.push_back(rank);
  }
  std::sort(ranks.begin(), ranks.end());
  return ranks;
}

}  // namespace

ProbeRanks measure_ranks(Codes prototypes, const std::vector<std::int64_t>& own,
                         const std::vector<std::int8_t>& centroids, const SearchTwo& search_two,
                         const CellOf& cell_of) {
  const ProbeRanks others =
      ranks_of(prototypes, [&](std::size_t q) { return own[q]; }, centroids, search_two, cell_of);
  const std::vector<std::int8_t> moved = like_observations(prototypes);
  ProbeRanks ranks = ranks_of(
      {moved.data(), prototypes.rows, prototypes.columns}, [](std::size_t) { return -1; },
      centroids, search_two, cell_of);
  // A map with a single landmark has no others.
  for (std::size_t i = 0; i < others.size(); ++i) ranks[i] = std::max(ranks[i], others[i]);
  return ranks;
}

std::size_t probes_for(const ProbeRanks& ranks, double recall, std::size_t cells) {
  if (recall >= 1 || ranks.empty()) return cells;
  // A share of n test queries is uncertain: two standard errors on top.
  const auto n = static_cast<double>(ranks.size());
  const double enough = n * recall + 2 * std::sqrt(n * recall * (1 - recall));
  if (enough > n) return cells;
  return ranks[static_cast<std::size_t>(std::ceil(enough)) - 1];
}

std::optional<std::size_t> asked_probes(const SearchOptions& options, std::size_t cells,
                                        const char* remedy) {
  if (!options.recall && !options.probes) return std::nullopt;
  if (options.recall && options.probes) {
    throw std::invalid_argument("recall and probes exclude each other");
  }
  if (options.recall) {
    check_recall(*options.recall, cells, remedy);
    return 0;
  }
  if (cells == 0) throw std::invalid_argument(std::string("probes needs an index: ") + remedy);
  if (*options.probes == 0) throw std::invalid_argument("probes must be at least 1");
  return std::min(*options.probes, cells);
}

void check_recall(double recall, std::size_t cells, const char* remedy) {
  if (!(recall > 0 && recall <= 1)) {
    throw std::invalid_argument("recall must be above 0 and at most 1");
  }
  if (cells == 0) throw std::invalid_argument(std::string("recall needs an index: ") + remedy);
}

SearchOptions exact(const SearchOptions& options) {
  SearchOptions result = options;
  result.recall = std::nullopt;
  result.probes = std::nullopt;
  return result;
}

}  // namespace protomark
