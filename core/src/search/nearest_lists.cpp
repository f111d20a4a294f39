// Selects the lists nearest to queries. TopK serves a few neighbours, here they may be hundreds.

#include <algorithm>

#include "base/parallel.h"
#include "search/inverted_lists.h"

namespace protomark {
namespace {

// A sample of one block of centroids in kMinStep or more limits the distance of the nearest ones,
// by that of about its kMaxRank-th nearest at most.
constexpr std::size_t kMinStep = 16, kMaxRank = 64;
// Up to so many lists a heap is faster than selection.
constexpr std::size_t kFewProbes = 16;
// Queries that are compared with the centroids together.
constexpr std::size_t kBatch = 256;

// What a query has found: distances above, indices of centroids below, so that the order of these
// numbers decides ties.
using Found = std::vector<std::int64_t>;

// The centroids against a batch of queries. For one thread.
class Selection {
 public:
  // `found` has room for each query of the batch.
  Selection(const PackedPrototypes& centroids, const PreparedCodes& queries, Range batch,
            std::vector<Found>& found)
      : centroids_(centroids),
        scan_(queries, batch),
        limits_(batch.size(), CodeScan::kNoLimit),
        found_(found) {
    for (Found& of_query : found_) of_query.clear();
  }

  // Writes (queries x nprobe) indices.
  void nearest(std::size_t nprobe, std::uint32_t* to) {
    guess_limits(nprobe);
    const auto limit_of = [&](std::size_t q) { return limits_[q]; };
    const auto take = [&](std::size_t q, std::int32_t distance, std::size_t list) {
      found_[q].push_back(std::int64_t{distance} * (std::int64_t{1} << 32) +
                          static_cast<std::int64_t>(list));
    };
    const std::size_t chunk = scan_.chunk_rows();
    for (std::size_t row = 0; row < centroids_.rows; row += chunk) {
      compare(row, std::min(chunk, centroids_.rows - row), limit_of, take);
    }
    for (std::uint32_t q = 0; q < limits_.size(); ++q) {
      if (found_[q].size() < nprobe) {
        found_[q].clear();
        scan_.select({&q, 1});
        compare(
            0, centroids_.rows, [](std::size_t) { return CodeScan::kNoLimit; },
            [&](std::size_t, std::int32_t distance, std::size_t list) { take(q, distance, list); });
      }
      select(found_[q], nprobe, to + q * nprobe);
    }
  }

 private:
  // Sets limits that are likely to leave some more than `nprobe` centroids.
  void guess_limits(std::size_t nprobe) {
    const std::size_t step = std::max(kMinStep, nprobe * 3 / 2 / kMaxRank);
    const std::size_t rank = nprobe * 3 / 2 / step + 5;
    Neighbours sample(rank, limits_);
    for (std::size_t row = 0; row < centroids_.rows; row += step * kPackedRows) {
      compare(
          row, std::min(kPackedRows, centroids_.rows - row),
          [&](std::size_t q) { return sample.limit(q); },
          [&](std::size_t q, std::int32_t distance, std::size_t list) {
            sample[q].offer(distance, static_cast<std::int64_t>(list));
          });
    }
    for (std::size_t q = 0; q < limits_.size(); ++q) limits_[q] = sample.limit(q);
  }

  static void select(Found& found, std::size_t nprobe, std::uint32_t* to) {
    const auto end = found.begin() + static_cast<std::ptrdiff_t>(nprobe);
    if (nprobe <= kFewProbes) {
      std::partial_sort(found.begin(), end, found.end());
    } else {
      std::nth_element(found.begin(), end - 1, found.end());
      std::iter_swap(found.begin(), std::min_element(found.begin(), end));
    }
    for (std::size_t i = 0; i < nprobe; ++i) to[i] = static_cast<std::uint32_t>(found[i]);
  }

  // Compares all queries with centroids from `first` on, a multiple of 16.
  template <typename LimitOf, typename Take>
  void compare(std::size_t first, std::size_t n, const LimitOf& limit_of, const Take& take) {
    const auto* codes = static_cast<const std::int8_t*>(centroids_.data);
    scan_.compare(
        codes + packed_size(first, centroids_.dim), n, limit_of,
        [&](std::size_t q, std::int32_t distance, std::size_t i) { take(q, distance, first + i); });
  }

  const PackedPrototypes& centroids_;
  CodeScan scan_;
  std::vector<std::int32_t> limits_;
  std::vector<Found>& found_;
};

}  // namespace

std::vector<std::uint32_t> nearest_lists(const PackedPrototypes& centroids,
                                         const PreparedCodes& queries, std::size_t nprobe,
                                         int threads) {
  std::vector<std::uint32_t> result(queries.queries() * nprobe);
  parallel_for(threads, queries.queries(), 16, [&](std::size_t first, std::size_t last) {
    std::vector<Found> found(std::min(kBatch, last - first));
    for (std::size_t q = first; q < last; q += kBatch) {
      Selection(centroids, queries, {q, std::min(last, q + kBatch)}, found)
          .nearest(nprobe, &result[q * nprobe]);
    }
  });
  return result;
}

}  // namespace protomark
