#include "search/recall.h"

#include <algorithm>
#include <cmath>

#include "base/quantize.h"
#include "search/scan.h"

namespace protomark {
namespace {

// Moves codes about as far as observations are from their prototypes, by 0.4 of the difference of
// two others, which has 0.32 times the variance of all codes; observations have 0.2 to 0.5 times.
std::vector<int8_t> like_observations(Codes codes) {
  std::vector<int8_t> result(codes.rows * codes.columns);
  for (size_t i = 0; i < codes.rows; ++i) {
    const int8_t* a = codes.row((i + 1) % codes.rows);
    const int8_t* b = codes.row((i + 2) % codes.rows);
    for (size_t d = 0; d < codes.columns; ++d) {
      const int moved = codes.row(i)[d] + 2 * (a[d] - b[d]) / 5;
      result[i * codes.columns + d] = static_cast<int8_t>(std::clamp(moved, -127, 127));
    }
  }
  return result;
}

// owner(q) is the landmark that query q must not find, if k is 2.
template <typename Owner>
RecallTable measure(Codes queries, const Owner& owner, const CoarseQuantizer& quantizer,
                    const ExactSearch& search, size_t k, const ListOf& list_of) {
  const size_t n = queries.rows, dim = queries.columns;
  const Matrix<int64_t> ids = search(queries, k).ids;
  // The list of the landmark that a query searches for, and the distance of its centroid.
  const PreparedCodes prepared(queries);
  std::vector<uint32_t> lists(n);
  std::vector<int32_t> limits(n, INT32_MIN);
  // If others are as near, the owner may be second, or not among the two. By landmark, as list_of
  // keeps the prototypes of one.
  std::vector<std::pair<int64_t, size_t>> nearest;
  for (size_t q = 0; q < n; ++q) {
    nearest.emplace_back(ids.row(q)[ids.row(q)[0] == owner(q) ? 1 : 0], q);
  }
  std::ranges::sort(nearest);
  for (const auto& [landmark, q] : nearest) {
    if (landmark < 0) continue;
    lists[q] = list_of(landmark, queries.row(q));
    const int8_t* centroid = &quantizer.centroids()[lists[q] * dim];
    limits[q] = squared_distance(centroid, queries.row(q), dim) - prepared.norms()[q];
  }
  RecallTable table(n, 0);  // counts the lists up to that one
  const PackedPrototypes centroids = quantizer.packed();
  CodeScan(prepared, {0, n})
      .compare(
          static_cast<const int8_t*>(centroids.data), centroids.rows,
          [&](size_t q) { return limits[q]; },
          [&](size_t q, int32_t distance, size_t list) {
            if (distance < limits[q] || list <= lists[q]) ++table[q];
          });
  std::erase(table, 0u);
  std::sort(table.begin(), table.end());
  return table;
}

}  // namespace

std::vector<size_t> test_rows(size_t rows) {
  const size_t n = std::min(rows, kTestQueries);
  std::vector<size_t> result(n);
  // Multiples of the golden ratio are evenly spread, but not in step with the rows from which lists
  // are learned.
  for (size_t i = 0; i < n; ++i) {
    const uint64_t x = (i + 1) * uint64_t{0x9e3779b97f4a7c15};
    result[i] = static_cast<size_t>((x >> 32) * rows >> 32);
  }
  return result;
}

RecallTable measure_recall(Codes prototypes, const std::vector<int64_t>& owners,
                           const CoarseQuantizer& quantizer, const ExactSearch& search,
                           const ListOf& list_of) {
  const RecallTable others =
      measure(prototypes, [&](size_t q) { return owners[q]; }, quantizer, search, 2, list_of);
  const std::vector<int8_t> moved = like_observations(prototypes);
  RecallTable table = measure(
      {moved.data(), prototypes.rows, prototypes.columns}, [](size_t) { return -1; }, quantizer,
      search, 1, list_of);
  // A map with a single landmark has no others.
  for (size_t i = 0; i < others.size(); ++i) table[i] = std::max(table[i], others[i]);
  return table;
}

size_t nprobe_for(const RecallTable& table, double recall, size_t nlist) {
  if (recall >= 1 || table.empty()) return nlist;
  // Two standard errors more, as the share that n test queries show is uncertain.
  const auto n = static_cast<double>(table.size());
  const double enough = n * recall + 2 * std::sqrt(n * recall * (1 - recall));
  if (enough > n) return nlist;
  return table[static_cast<size_t>(std::ceil(enough)) - 1];
}

void check_recall(double recall, size_t nlist, const char* remedy) {
  if (!(recall > 0 && recall <= 1)) invalid("recall must be above 0 and at most 1");
  if (nlist == 0) invalid("recall needs an index: ", remedy);
}

void check_lists(const SearchOptions& options, size_t nlist, const char* remedy) {
  if (options.recall && options.nprobe) invalid("recall and nprobe exclude each other");
  if (options.recall) check_recall(*options.recall, nlist, remedy);
  if (!options.nprobe) return;
  if (nlist == 0) invalid("nprobe needs an index: ", remedy);
  if (*options.nprobe == 0) invalid("nprobe must be at least 1");
}

}  // namespace protomark
