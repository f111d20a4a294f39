#include "search/nearest_cells.h"

#include <algorithm>
#include <array>

#include "base/parallel.h"
#include "kernels/kernels.h"
#include "search/top_k.h"

namespace protomark {
namespace {

// One block in so many, or fewer, tells how near the nearest centroids are: by the distance of at
// most about so many of them.
constexpr std::size_t kLeastStep = 16, kMostRank = 64;
// Up to here a heap of the nearest is faster than selection.
constexpr std::size_t kFewProbes = 16;

// Beyond all distances.
constexpr std::int32_t kNoLimit = 1 << 25;

// All centroids against some queries at a time. For one thread.
class Ranking {
 public:
  explicit Ranking(const PackedPrototypes& centroids)
      : centroids_(centroids),
        dim_(packed_dim(centroids.dim)),
        blocks_((centroids.rows + kPackedRows - 1) / kPackedRows),
        queries_(kernels::kScanQueries * dim_),
        biases_(blocks_ * kPackedRows),
        hits_(kernels::kHitRoom),
        found_(kernels::kScanQueries) {
    // In all dimensions at once: many are wanted.
    kernels::active().code_biases(centroids.data, blocks_, dim_, dim_, biases_.data(), nullptr);
  }

  // At most kScanQueries queries.
  void nearest(Codes queries, std::size_t probes, std::uint32_t* to) {
    std::fill(queries_.begin(), queries_.end(), 128);
    for (std::size_t q = 0; q < queries.rows; ++q) {
      for (std::size_t d = 0; d < queries.columns; ++d) {
        queries_[q * dim_ + d] = static_cast<std::uint8_t>(queries.row(q)[d] + 128);
      }
    }
    guess_limits(queries.rows, probes);
    scan(0, queries.rows, 0, blocks_);
    for (std::size_t q = 0; q < queries.rows; ++q) {
      if (found_[q].size() < probes) {
        found_[q].clear();
        limits_[q] = kNoLimit;
        scan(q, 1, 0, blocks_);
      }
      select(found_[q], probes, to + q * probes);
      found_[q].clear();
    }
  }

 private:
  // Distances above, numbers of cells below.
  using Found = std::vector<std::int64_t>;

  // Limits that are likely to leave some more than `probes` cells, by the nearest of a sample.
  void guess_limits(std::size_t queries, std::size_t probes) {
    const std::size_t step = std::max(kLeastStep, probes * 3 / 2 / kMostRank);
    const std::size_t rank = probes * 3 / 2 / step + 5;
    sample_cells_.resize(queries * rank);
    sample_distances_.resize(queries * rank);
    std::vector<TopK> nearest;
    for (std::size_t q = 0; q < queries; ++q) {
      nearest.emplace_back(&sample_cells_[q * rank], &sample_distances_[q * rank], rank, kNoLimit);
    }
    std::fill(limits_.begin(), limits_.end(), kNoLimit);
    for (std::size_t block = 0; block < blocks_; block += step) {
      each_hit(0, queries, block, block + 1, [&](std::size_t q, const kernels::Hit& hit) {
        nearest[q].offer(hit.distance, hit.row);
      });
      for (std::size_t q = 0; q < queries; ++q) limits_[q] = nearest[q].limit();
    }
  }

  static void select(Found& found, std::size_t probes, std::uint32_t* to) {
    const auto end = found.begin() + static_cast<std::ptrdiff_t>(probes);
    if (probes <= kFewProbes) {
      std::partial_sort(found.begin(), end, found.end());
    } else {
      std::nth_element(found.begin(), end - 1, found.end());
      std::iter_swap(found.begin(), std::min_element(found.begin(), end));
    }
    for (std::size_t i = 0; i < probes; ++i) to[i] = static_cast<std::uint32_t>(found[i]);
  }

  void scan(std::size_t query, std::size_t queries, std::size_t block, std::size_t end) {
    each_hit(query, queries, block, end, [&](std::size_t q, const kernels::Hit& hit) {
      found_[q].push_back(std::int64_t{hit.distance} * (std::int64_t{1} << 32) + hit.row);
    });
  }

  // Calls take(query, hit) for what is within the limits in some blocks.
  template <typename Take>
  void each_hit(std::size_t query, std::size_t queries, std::size_t block, std::size_t end,
                const Take& take) {
    while (block < end) {
      const std::size_t n = kernels::active().code_scan(
          {&queries_[query * dim_], &limits_[query], &tails_[query], queries, &put_off_},
          {centroids_.data, biases_.data(), biases_.data(), end, dim_, dim_}, &block, hits_.data());
      for (std::size_t i = 0; i < n; ++i) {
        if (hits_[i].row < centroids_.rows) take(query + hits_[i].query, hits_[i]);
      }
    }
  }

  PackedPrototypes centroids_;
  std::size_t dim_;
  std::size_t blocks_;
  std::vector<std::uint8_t> queries_;
  std::array<std::int32_t, kernels::kScanQueries> limits_, tails_{};
  std::size_t put_off_ = 0;
  std::vector<std::int32_t> biases_;
  std::vector<kernels::Hit> hits_;
  std::vector<std::int64_t> sample_cells_;
  std::vector<std::int32_t> sample_distances_;
  std::vector<Found> found_;  // of each query
};

}  // namespace

std::vector<std::uint32_t> nearest_cells(const PackedPrototypes& centroids, Codes queries,
                                         std::size_t probes, int threads) {
  std::vector<std::uint32_t> result(queries.rows * probes);
  parallel_for(threads, queries.rows, 16, [&](std::size_t first, std::size_t last) {
    Ranking ranking(centroids);
    for (std::size_t q = first; q < last; q += kernels::kScanQueries) {
      const std::size_t n = std::min(kernels::kScanQueries, last - q);
      ranking.nearest({queries.row(q), n, queries.columns}, probes, &result[q * probes]);
    }
  });
  return result;
}

}  // namespace protomark
