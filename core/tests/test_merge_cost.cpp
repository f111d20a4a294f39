
#include <algorithm>
#include <map>
#include <utility>

#include "check.h"
#include "map/sealed_store.h"
#include "random.h"
#include "store_rows.h"

using namespace protomark;

namespace {

struct Cluster {
  std::vector<std::int64_t> sum;
  std::int64_t n;
};

double cost(const Cluster& a, const Cluster& b) {
  std::int64_t total = 0;
  for (std::size_t d = 0; d < a.sum.size(); ++d) {
    const std::int64_t difference = b.n * a.sum[d] - a.n * b.sum[d];
    total += difference * difference;
  }
  return static_cast<double>(total) / static_cast<double>(a.n * b.n * (a.n + b.n));
}

// Every pair at every step, in exact integers.
std::vector<AppearanceMerge> plain_merges(const std::vector<std::int16_t>& sums,
                                          const std::vector<std::uint8_t>& counts,
                                          std::size_t dim) {
  std::vector<Cluster> clusters;
  for (std::size_t i = 0; i < counts.size(); ++i) {
    clusters.push_back({{&sums[i * dim], &sums[i * dim] + dim}, counts[i]});
  }
  std::vector<AppearanceMerge> merges;
  while (merges.size() + 1 < counts.size()) {
    std::size_t best_i = 0, best_j = 0;
    double best = -1;
    for (std::size_t i = 0; i < clusters.size(); ++i) {
      for (std::size_t j = i + 1; j < clusters.size(); ++j) {
        if (clusters[i].n == 0 || clusters[j].n == 0) continue;
        const double c = cost(clusters[i], clusters[j]);
        if (best >= 0 && c >= best) continue;
        best = c;
        best_i = i;
        best_j = j;
      }
    }
    merges.push_back(
        {best, static_cast<std::uint16_t>(best_i), static_cast<std::uint16_t>(best_j)});
    for (std::size_t d = 0; d < dim; ++d) clusters[best_i].sum[d] += clusters[best_j].sum[d];
    clusters[best_i].n += std::exchange(clusters[best_j].n, 0);
  }
  return merges;
}

// Merges the pair of least cost over the whole map, ties to the first rows of the smallest id,
// until there are at most `limit` rows.
std::map<std::int64_t, std::vector<Cluster>> plain_store(const PrototypeStore& store,
                                                         std::size_t dim, std::size_t limit) {
  std::map<std::int64_t, std::vector<Cluster>> landmarks;
  for (const LandmarkIndex landmark : store.sorted_landmarks()) {
    for (const Row row : store.sorted_rows(landmark)) {
      const Sum sum = store.sum(row);
      landmarks[store.id(landmark)].push_back({{sum.begin(), sum.begin() + dim}, store.count(row)});
    }
  }
  for (std::size_t rows = store.prototype_count(); rows > limit; --rows) {
    std::vector<Cluster>* best = nullptr;
    std::size_t best_i = 0, best_j = 0;
    double least = -1;
    for (auto& [id, clusters] : landmarks) {
      for (std::size_t i = 0; i < clusters.size(); ++i) {
        for (std::size_t j = i + 1; j < clusters.size(); ++j) {
          const double c = cost(clusters[i], clusters[j]);
          if (best != nullptr && c >= least) continue;
          best = &clusters, best_i = i, best_j = j, least = c;
        }
      }
    }
    if (best == nullptr) break;
    Cluster& into = (*best)[best_i];
    for (std::size_t d = 0; d < dim; ++d) into.sum[d] += (*best)[best_j].sum[d];
    into.n += (*best)[best_j].n;
    best->erase(best->begin() + static_cast<std::ptrdiff_t>(best_j));
  }
  return landmarks;
}

void merged_stores_equal_plain_ones() {
  test::Random random(9);
  for (int round = 0; round < 100; ++round) {
    const auto dim = static_cast<std::size_t>(random.integer(1, 9));
    PrototypeStore store(dim, 8);
    // Small values make many costs equal, so that the order of rows decides.
    const std::int64_t limit = round % 2 == 0 ? 1 : 127;
    for (int i = 0; i < 60; ++i) {
      const auto appearance = static_cast<std::uint16_t>(random.integer(0, 15));
      const int n = static_cast<int>(random.integer(1, 3));
      Sum sum{};
      for (std::size_t d = 0; d < dim; ++d) {
        sum[d] = static_cast<std::int16_t>(n * random.integer(-limit, limit));
      }
      store.merge(test::find_or_create_row(store, random.integer(0, 9) * 7, appearance), sum, n);
    }
    for (const std::size_t wanted : {0, 10, 20, 35, 50}) {
      const auto length = static_cast<std::size_t>(random.integer(1, static_cast<int>(dim)));
      const auto merged = merge_appearances(store, length, wanted);
      CHECK(merged.has_value() == (wanted < store.prototype_count() || length < dim));
      if (!merged) continue;
      CHECK(merged->dim() == length);
      const auto expected = plain_store(store, length, wanted);
      CHECK(merged->landmark_count() == expected.size());
      bool equal = true;
      for (const auto& [id, clusters] : expected) {
        const std::vector<Row> rows = merged->sorted_rows(merged->at(id));
        equal = equal && rows.size() == clusters.size();
        for (std::size_t i = 0; equal && i < rows.size(); ++i) {
          equal = merged->count(rows[i]) == clusters[i].n &&
                  std::equal(clusters[i].sum.begin(), clusters[i].sum.end(),
                             merged->sum(rows[i]).begin());
        }
      }
      CHECK(equal);
    }
  }
}

}  // namespace

int main() {
  merged_stores_equal_plain_ones();
  test::Random random(8);
  for (int round = 0; round < 400; ++round) {
    const auto rows = static_cast<std::size_t>(random.integer(1, round < 390 ? 12 : 60));
    const auto dim = static_cast<std::size_t>(random.integer(1, 33));
    // Small values make many costs equal.
    const std::int64_t limit = round % 2 == 0 ? 1 : 127;
    const auto counts = random.integers<std::uint8_t>(rows, 1, round % 3 == 0 ? 2 : 20);
    std::vector<std::int16_t> sums;
    for (std::size_t i = 0; i < rows * dim; ++i) {
      sums.push_back(static_cast<std::int16_t>(counts[i / dim] * random.integer(-limit, limit)));
    }
    const auto merges = appearance_merges(sums, counts, dim),
               expected = plain_merges(sums, counts, dim);
    CHECK(merges.size() == rows - 1);
    for (std::size_t i = 0; i < std::min(merges.size(), expected.size()); ++i) {
      CHECK(merges[i].cost == expected[i].cost);
      CHECK(merges[i].into == expected[i].into && merges[i].source == expected[i].source);
    }
  }

  // The largest sums there are: 600 full rows whose values are at the ends of their range.
  const std::size_t rows = 600, dim = 2;
  const std::vector<std::uint8_t> counts(rows, 255);
  std::vector<std::int16_t> sums;
  for (std::size_t i = 0; i < rows * dim; ++i) {
    sums.push_back(static_cast<std::int16_t>(i / dim % 2 == 0 ? 255 * 127 : -255 * 127));
  }
  const auto merges = appearance_merges(sums, counts, dim);
  for (std::size_t i = 0; i + 1 < merges.size(); ++i) CHECK(merges[i].cost == 0);
  // Half of the rows at each end: 2 dimensions, 254 apart, n m / (n + m) = 300 * 255 / 2.
  CHECK(merges.back().cost == 2.0 * 254 * 254 * (300 * 255 / 2));
  CHECK(appearance_merges({}, {}, 3).empty());

  // As many rows as possible, which took minutes before neighbours were merged first.
  const std::size_t most = 65536;
  std::vector<std::int16_t> many(most);
  for (std::size_t i = 0; i < most; ++i) many[i] = static_cast<std::int16_t>(i % 251);
  const auto all = appearance_merges(many, std::vector<std::uint8_t>(most, 1), 1);
  CHECK(all.size() == most - 1);
  CHECK(all[0].into == 0 && all[0].source == 1 && all[0].cost == 0);
  std::vector<bool> removed(most, false);
  for (const auto& merge : all) {
    CHECK(merge.into < merge.source && !removed[merge.into] && !removed[merge.source]);
    removed[merge.source] = true;
  }
  return check::result();
}
