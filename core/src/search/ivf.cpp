#include "search/ivf.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <queue>
#include <utility>

#include "base/rounded_mean.h"
#include "search/ivf_search.h"
#include "search/recall.h"

namespace protomark {
namespace {

constexpr int kIterations = 8;
constexpr std::size_t kGroupProbes = 4;
// Codes whose cells are looked for at a time.
constexpr std::size_t kAssignChunk = 1 << 14;

// The number of the nearest prototype of each code, as nearest(codes, ids, distances) finds it.
template <typename Nearest>
std::vector<std::uint32_t> nearest_numbers(Codes codes, const Nearest& nearest) {
  std::vector<std::uint32_t> result(codes.rows);
  std::vector<std::int64_t> ids(std::min(codes.rows, kAssignChunk));
  std::vector<float> distances(ids.size());
  for (std::size_t first = 0; first < codes.rows; first += kAssignChunk) {
    const std::size_t n = std::min(kAssignChunk, codes.rows - first);
    nearest({codes.row(first), n, codes.columns}, MatrixView<std::int64_t>{ids.data(), n, 1},
            MatrixView<float>{distances.data(), n, 1});
    std::copy_n(ids.begin(), n, result.begin() + static_cast<std::ptrdiff_t>(first));
  }
  return result;
}

SearchOptions on(int threads) {
  SearchOptions options;
  options.threads = threads;
  return options;
}

// Centroids without codes take a code each of the largest cells.
void repair(Codes codes, const std::vector<std::uint32_t>& cell_of,
            const std::vector<std::uint32_t>& counts, std::vector<std::int8_t>& centroids) {
  const std::size_t cells = counts.size(), dim = codes.columns;
  std::vector<std::uint32_t> first(cells + 1, 0);
  for (std::size_t c = 0; c < cells; ++c) first[c + 1] = first[c] + counts[c];
  std::vector<std::uint32_t> members(codes.rows);
  {
    std::vector<std::uint32_t> next(first.begin(), first.end() - 1);
    for (std::size_t i = 0; i < codes.rows; ++i) {
      members[next[cell_of[i]]++] = static_cast<std::uint32_t>(i);
    }
  }
  struct Large {
    std::size_t share;  // codes for each centroid that the cell has got
    std::size_t cell;
    std::size_t parts;
    bool operator<(const Large& other) const {
      return std::pair(share, other.cell) < std::pair(other.share, cell);
    }
  };
  std::priority_queue<Large> largest;
  for (std::size_t c = 0; c < cells; ++c) largest.push({counts[c], c, 1});
  for (std::size_t c = 0; c < cells; ++c) {
    if (counts[c] != 0) continue;
    Large from = largest.top();
    largest.pop();
    // A different code each time, spread over the cell.
    const std::size_t at = first[from.cell] + counts[from.cell] / (from.parts + 1);
    std::copy_n(codes.row(members[at]), dim, &centroids[c * dim]);
    ++from.parts;
    from.share = counts[from.cell] / from.parts;
    largest.push(from);
  }
}

// `assign(centroids)` gives the cell of each code.
template <typename Assign>
std::vector<std::int8_t> k_means(Codes codes, std::size_t cells, const Assign& assign) {
  const std::size_t dim = codes.columns;
  std::vector<std::int8_t> centroids(cells * dim);
  for (std::size_t c = 0; c < cells; ++c) {
    std::copy_n(codes.row(c * codes.rows / cells), dim, &centroids[c * dim]);
  }
  std::vector<std::int64_t> sums(centroids.size());
  std::vector<std::uint32_t> counts(cells);
  for (int i = 0; i < kIterations; ++i) {
    const std::vector<std::uint32_t> cell_of = assign(centroids);
    std::fill(sums.begin(), sums.end(), 0);
    std::fill(counts.begin(), counts.end(), 0);
    for (std::size_t row = 0; row < codes.rows; ++row) {
      const std::size_t c = cell_of[row];
      for (std::size_t d = 0; d < dim; ++d) sums[c * dim + d] += codes.row(row)[d];
      ++counts[c];
    }
    for (std::size_t c = 0; c < cells; ++c) {
      if (counts[c] == 0) continue;
      for (std::size_t d = 0; d < dim; ++d) {
        centroids[c * dim + d] = rounded_mean<std::int64_t>(sums[c * dim + d], counts[c]);
      }
    }
    repair(codes, cell_of, counts, centroids);
  }
  return centroids;
}

}  // namespace

std::vector<CodeVector> pack_codes(Codes codes) {
  std::vector<CodeVector> result(packed_size(codes.rows, codes.columns) / sizeof(CodeVector));
  auto* to = reinterpret_cast<std::int8_t*>(result.data());
  for (std::size_t row = 0; row < codes.rows; ++row) {
    for (std::size_t d = 0; d < codes.columns; ++d) {
      to[packed_index(row, d, codes.columns)] = codes.row(row)[d];
    }
  }
  return result;
}

CellOrder::CellOrder(std::vector<std::uint32_t> cell_of_row, std::size_t cells)
    : rows(cells, 0), first_blocks(cells + 1, 0), places(std::move(cell_of_row)) {
  for (const std::uint32_t cell : places) {
    if (cell != kNone) ++rows[cell];
  }
  for (std::size_t c = 0; c < cells; ++c) {
    first_blocks[c + 1] =
        first_blocks[c] + static_cast<std::uint32_t>((rows[c] + kPackedRows - 1) / kPackedRows);
  }
  std::vector<std::uint32_t> next(cells);
  for (std::size_t c = 0; c < cells; ++c) {
    next[c] = first_blocks[c] * static_cast<std::uint32_t>(kPackedRows);
  }
  for (std::uint32_t& cell_or_place : places) {
    if (cell_or_place != kNone) cell_or_place = next[cell_or_place]++;
  }
}

Cells::Cells(std::vector<std::int8_t> centroids, std::size_t dim)
    : dim_(dim), centroids_(std::move(centroids)) {
  const std::size_t n = size();
  const Codes all{centroids_.data(), n, dim_};
  packed_.codes = pack_codes(all);

  const auto groups =
      std::min(n, static_cast<std::size_t>(std::ceil(2 * std::sqrt(static_cast<double>(n)))));
  const auto nearest_group = [&](const PackedPrototypes& to) {
    return nearest_numbers(
        all, [&](Codes codes, auto ids, auto distances) { search(to, codes, {}, ids, distances); });
  };
  const auto assign = [&](const std::vector<std::int8_t>& to) {
    const Packed packed{pack_codes({to.data(), groups, dim_})};
    return nearest_group(packed.view(groups, dim_));
  };
  const std::vector<std::int8_t> group_centroids = k_means(all, groups, assign);
  const CellOrder order(assign(group_centroids), groups);
  // A group that is nearest to no centroid, as centroids of a broken file might have, is left out.
  std::vector<std::int8_t> kept;
  for (std::size_t g = 0; g < groups; ++g) {
    if (order.rows[g] == 0) continue;
    kept.insert(kept.end(), &group_centroids[g * dim_], &group_centroids[g * dim_] + dim_);
    group_sizes_.push_back(order.rows[g]);
    group_blocks_.push_back(order.first_blocks[g]);
  }
  group_blocks_.push_back(order.first_blocks.back());
  group_centroids_.codes = pack_codes({kept.data(), group_sizes_.size(), dim_});
  const std::size_t places = order.first_blocks.back() * kPackedRows;
  std::vector<std::int8_t> grouped(places * dim_, 0);
  cell_of_.assign(places, 0);
  for (std::size_t cell = 0; cell < n; ++cell) {
    std::copy_n(all.row(cell), dim_, &grouped[order.places[cell] * dim_]);
    cell_of_[order.places[cell]] = static_cast<std::uint32_t>(cell);
  }
  grouped_.codes = pack_codes({grouped.data(), places, dim_});
}

Cells Cells::learn(Codes codes, std::size_t cells, int threads) {
  const auto assign = [&](const std::vector<std::int8_t>& centroids) {
    return Cells(centroids, codes.columns).assign(codes, threads);
  };
  return {k_means(codes, cells, assign), codes.columns};
}

std::size_t Cells::number_for(std::size_t prototypes, std::size_t dim, std::size_t place) {
  const auto n = static_cast<double>(prototypes), k = static_cast<double>(packed_dim(dim));
  constexpr double kBytes = 4;
  // A sealed map has what docs/format.md has: numbers of landmarks, ranks, and for each cell its
  // centroid, its number of rows and half a block of padding, somewhat rounded up.
  const double ranks = static_cast<double>(std::min(prototypes, kTestQueries)) * sizeof(float);
  const double sealed = (n * (kBytes - std::bit_width(prototypes) / 8.0) - ranks) / (9.5 * k + 4);
  // An open one has for each cell its centroid three times and some numbers, half a block of places
  // and half of the 12 bytes of a block.
  const double half = static_cast<double>(kPackedRows * place) / 2 + 6;
  const double open = (n * kBytes - ranks) / (half + 3 * k + 16);
  const double cells = std::min({4 * std::sqrt(n), sealed, open});
  return static_cast<std::size_t>(std::clamp(cells, 1.0, static_cast<double>(kMaxCells)));
}

std::vector<std::uint32_t> Cells::assign(Codes codes, int threads) const {
  PackedPrototypes grouped = grouped_.view(cell_of_.size(), dim_);
  grouped.landmarks.of_row = cell_of_.data();
  const CellView view(group_sizes_, group_blocks_);
  const PackedPrototypes centroids = group_centroids_.view(group_sizes_.size(), dim_);
  return nearest_numbers(codes, [&](Codes some, auto ids, auto distances) {
    search_cells(grouped, view, centroids, kGroupProbes, some, on(threads), ids, distances);
  });
}

}  // namespace protomark
