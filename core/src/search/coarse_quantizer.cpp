#include "search/coarse_quantizer.h"

#include <bit>
#include <cmath>
#include <numeric>
#include <queue>
#include <set>
#include <tuple>

#include "base/quantize.h"
#include "search/inverted_lists.h"

namespace protomark {
namespace {

constexpr int kIterations = 8;
constexpr size_t kGroupProbes = 4;
// Centroids of a group at most, in terms of the mean.
constexpr size_t kLargestGroup = 4;
std::vector<uint32_t> ids_of(const Matches& nearest) {
  return {nearest.ids.data.begin(), nearest.ids.data.end()};
}

// Replaces each centroid without codes by a code of the largest lists.
void refill(Codes codes, const std::vector<uint32_t>& list_of, const std::vector<uint32_t>& counts,
            Matrix<int8_t>& centroids) {
  const size_t nlist = counts.size();
  std::vector<uint32_t> first(nlist), members(codes.rows);
  std::exclusive_scan(counts.begin(), counts.end(), first.begin(), 0u);
  std::vector<uint32_t> next = first;
  for (uint32_t i = 0; i < codes.rows; ++i) members[next[list_of[i]]++] = i;
  // Codes per centroid that a list has got, lists from last to first, and its centroids.
  std::priority_queue<std::tuple<uint32_t, size_t, uint32_t>> largest;
  for (size_t c = 0; c < nlist; ++c) largest.emplace(counts[c], nlist - 1 - c, 1);
  for (size_t c = 0; c < nlist; ++c) {
    if (counts[c] != 0) continue;
    const auto [share, from_last, parts] = largest.top();
    largest.pop();
    const size_t list = nlist - 1 - from_last;
    // Another code each time, spread over the list.
    const size_t at = first[list] + counts[list] / (parts + 1);
    std::copy_n(codes.row(members[at]), codes.columns, centroids.row(c));
    largest.emplace(counts[list] / (parts + 1), from_last, parts + 1);
  }
}

// `assign(centroids)` returns the list of each code.
Matrix<int8_t> k_means(Codes codes, size_t nlist, const auto& assign) {
  const size_t dim = codes.columns;
  Matrix<int8_t> centroids(nlist, dim);
  for (size_t c = 0; c < nlist; ++c) {
    std::copy_n(codes.row(c * codes.rows / nlist), dim, centroids.row(c));
  }
  for (int i = 0; i < kIterations; ++i) {
    const std::vector<uint32_t> list_of = assign(centroids);
    Matrix<int64_t> sums(nlist, dim);
    std::vector<uint32_t> counts(nlist, 0);
    for (size_t row = 0; row < codes.rows; ++row) {
      const size_t c = list_of[row];
      for (size_t d = 0; d < dim; ++d) sums.row(c)[d] += codes.row(row)[d];
      ++counts[c];
    }
    for (size_t c = 0; c < nlist; ++c) {
      if (counts[c] == 0) continue;
      for (size_t d = 0; d < dim; ++d) {
        centroids.row(c)[d] = rounded_mean<int64_t>(sums.row(c)[d], counts[c]);
      }
    }
    refill(codes, list_of, counts, centroids);
  }
  return centroids;
}

}  // namespace

ListOrder::ListOrder(std::vector<Row> lists, size_t nlist)
    : sizes(nlist, 0), first_blocks(nlist + 1, 0), new_rows(std::move(lists)) {
  for (const Row list : new_rows) {
    if (list != kNoRow) ++sizes[list.value];
  }
  std::vector<uint32_t> next(nlist);
  for (size_t c = 0; c < nlist; ++c) {
    next[c] = first_blocks[c] * static_cast<uint32_t>(kPackedRows);
    first_blocks[c + 1] = first_blocks[c] + static_cast<uint32_t>(packed_blocks(sizes[c]));
  }
  for (Row& list_or_row : new_rows) {
    if (list_or_row != kNoRow) list_or_row.value = next[list_or_row.value]++;
  }
}

CoarseQuantizer::CoarseQuantizer(Matrix<int8_t> centroids)
    : centroids_(std::move(centroids)), packed_(pack_codes(centroids_)) {
  const size_t dim = centroids_.columns;
  // Of equal centroids only the first one gets codes.
  std::vector<int8_t> distinct;
  std::vector<LandmarkIndex> lists;
  std::set<std::span<const int8_t>, decltype(std::ranges::lexicographical_compare)> seen;
  for (LandmarkIndex list{0}; list.value < nlist(); ++list.value) {
    const std::span<const int8_t> centroid(centroids_.row(list.value), dim);
    if (!seen.insert(centroid).second) continue;
    distinct.insert(distinct.end(), centroid.begin(), centroid.end());
    lists.push_back(list);
  }
  const size_t n = lists.size();
  const Codes all{distinct.data(), n, dim};

  const auto groups =
      std::min(n, static_cast<size_t>(std::ceil(2 * std::sqrt(static_cast<double>(n)))));
  const auto assign = [&](const Matrix<int8_t>& to) {
    const std::vector<CodeVector> packed = pack_codes(to);
    return ids_of(search_exact(packed_view(packed, groups), all, 1, {}));
  };
  const Matrix<int8_t> group_centroids = k_means(all, groups, assign);
  // Cuts large groups into parts, as k-means may leave nearly all centroids in one, with all of
  // which each code would be compared. Groups without centroids are left out.
  const size_t limit = kLargestGroup * ((n + groups - 1) / groups);
  std::vector<int8_t> used;
  std::vector<uint32_t> sizes(groups, 0), parts(groups);
  std::vector<Row> group_of;
  for (const uint32_t g : assign(group_centroids)) {
    if (sizes[g]++ % limit == 0) {
      parts[g] = static_cast<uint32_t>(used.size() / dim);
      used.insert(used.end(), group_centroids.row(g), group_centroids.row(g) + dim);
    }
    group_of.push_back({parts[g]});
  }
  ListOrder order(std::move(group_of), used.size() / dim);
  group_centroids_ = pack_codes({used.data(), order.sizes.size(), dim});
  Matrix<int8_t> grouped(order.first_blocks.back() * kPackedRows, dim);
  list_of_.assign(grouped.rows, kNoLandmark);
  for (size_t i = 0; i < n; ++i) {
    const Row row = order.new_rows[i];
    std::copy_n(all.row(i), dim, grouped.row(row.value));
    list_of_[row.value] = lists[i];
  }
  grouped_ = pack_codes(grouped);
  group_sizes_ = std::move(order.sizes);
  group_blocks_ = std::move(order.first_blocks);
}

CoarseQuantizer CoarseQuantizer::learn(Codes codes, size_t nlist, int threads) {
  return CoarseQuantizer(k_means(codes, nlist, [&](const Matrix<int8_t>& centroids) {
    return CoarseQuantizer(centroids).assign(codes, threads);
  }));
}

size_t CoarseQuantizer::default_nlist(size_t prototypes, size_t dim, size_t row_bytes) {
  const auto n = static_cast<double>(prototypes), k = static_cast<double>(packed_dim(dim));
  constexpr double kBytes = 4;
  // A sealed map stores the landmark of each row, the recall table, and for each list its centroid,
  // its number of rows and half a block of padding, rounded up.
  const double table = static_cast<double>(std::min(prototypes, kTestQueries)) * sizeof(float);
  const double sealed =
      (n * (kBytes - static_cast<double>(std::bit_width(prototypes)) / 8) - table) / (9.5 * k + 4);
  // A learning map keeps for each list its centroid three times, 16 bytes, and half a block.
  const double half_block = static_cast<double>(kPackedRows * row_bytes) / 2 + 6;
  const double learning = (n * kBytes - table) / (half_block + 3 * k + 16);
  const double nlist = std::min({4 * std::sqrt(n), sealed, learning});
  return static_cast<size_t>(std::clamp(nlist, 1.0, static_cast<double>(kMaxLists)));
}

CoarseQuantizer CoarseQuantizer::cut(size_t dim) const {
  if (dim == centroids_.columns || nlist() == 0) return *this;
  Matrix<int8_t> centroids(nlist(), dim);
  for (size_t c = 0; c < nlist(); ++c) std::copy_n(centroids_.row(c), dim, centroids.row(c));
  return CoarseQuantizer(std::move(centroids));
}

std::vector<uint32_t> CoarseQuantizer::assign(Codes codes, int threads) const {
  PackedPrototypes grouped = packed_view(grouped_, list_of_.size());
  grouped.landmarks.of_row = list_of_.data();
  const InvertedLists groups(group_sizes_, group_blocks_);
  const PackedPrototypes centroids = packed_view(group_centroids_, group_sizes_.size());
  return ids_of(
      search_lists(grouped, groups, centroids, kGroupProbes, codes, 1, {.threads = threads}));
}

}  // namespace protomark
