// What exact, inverted-list and Hamming search share: how they are divided among threads, their
// loop over the hits of a kernel, and how they write their answer.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <optional>
#include <span>
#include <stdexcept>

#include "base/parallel.h"
#include "kernels/kernels.h"
#include "protomark/types.h"
#include "search/top_k.h"

namespace protomark {

// How many ranges of queries, each with how many ranges of work (rows, or lists), a search has.
struct Division {
  std::size_t query_ranges = 1;
  std::size_t work_ranges = 1;

  // Divides the queries first, as those of a range share the work on each row that does not depend
  // on the query. If they are too few for all threads, divides the rows as well.
  static Division of_rows(int threads, std::size_t queries, std::size_t rows) {
    constexpr std::size_t kQueries = 64, kRows = 4096;
    if (threads <= 1 || queries == 0) return {};
    const auto n = static_cast<std::size_t>(threads);
    const std::size_t query_ranges = std::min(4 * n, divide_up(queries, kQueries));
    const std::size_t work_ranges = std::min(divide_up(n, query_ranges), divide_up(rows, kRows));
    return {query_ranges, std::max<std::size_t>(work_ranges, 1)};
  }
  // Divides only the probes, as all queries of a list share the reading of it.
  static Division of_lists(int threads, std::size_t probes) {
    constexpr std::size_t kProbes = 64;
    if (threads <= 1) return {};
    return {1, std::clamp<std::size_t>(divide_up(probes, kProbes), 1,
                                       4 * static_cast<std::size_t>(threads))};
  }

  static Range range(std::size_t n, std::size_t ranges, std::size_t i) {
    constexpr std::size_t kGrain = 16;
    const std::size_t grains = divide_up(n, kGrain);
    return {std::min(n, grains * i / ranges * kGrain),
            std::min(n, grains * (i + 1) / ranges * kGrain)};
  }

 private:
  static std::size_t divide_up(std::size_t a, std::size_t b) { return (a + b - 1) / b; }
};

// Calls scan(queries, work, neighbours of these queries) for all ranges.
template <typename Scan>
void run_search(int threads, const Division& division, std::size_t work, Neighbours& nearest,
                const Scan& scan) {
  std::mutex mutex;
  const std::size_t tasks = division.query_ranges * division.work_ranges;
  run_tasks(threads, nearest.queries() == 0 ? 0 : tasks, [&](std::size_t i) {
    if (tasks == 1) return scan(Range{0, nearest.queries()}, Range{0, work}, nearest);
    const Range queries =
        Division::range(nearest.queries(), division.query_ranges, i / division.work_ranges);
    std::unique_lock lock(mutex);
    Neighbours part = nearest.part(queries);
    lock.unlock();
    scan(queries, Division::range(work, division.work_ranges, i % division.work_ranges), part);
    lock.lock();
    nearest.merge(queries.begin, part);
  });
}

// Visits the hits of n queries among the rows of a chunk. kernel(first, n, limits, &block, hits)
// scans for some queries from a block on. take(query, distance, row) gets the rows within
// limit_of(query), which it may tighten.
template <typename Kernel, typename LimitOf, typename Take>
void each_hit(std::size_t n, std::size_t rows, std::size_t blocks, const Kernel& kernel,
              const LimitOf& limit_of, const Take& take) {
  kernels::Hit hits[kernels::kHitRoom];
  std::int32_t limits[kernels::kScanQueries];
  for (std::size_t first = 0; first < n; first += kernels::kScanQueries) {
    const std::size_t group = std::min(kernels::kScanQueries, n - first);
    for (std::size_t block = 0; block < blocks;) {
      for (std::size_t i = 0; i < group; ++i) limits[i] = limit_of(first + i);
      const std::size_t found = kernel(first, group, limits, &block, hits);
      for (std::size_t i = 0; i < found; ++i) {
        const kernels::Hit& hit = hits[i];
        // Earlier hits may have tightened the limit.
        if (hit.row >= rows || hit.distance > limits[hit.query]) continue;
        take(first + hit.query, hit.distance, hit.row);
        limits[hit.query] = limit_of(first + hit.query);
      }
    }
  }
}

// Writes (queries x k) ids and distances. `norms`, if there are any, are added to the distances of
// each query.
inline void write_answer(const Neighbours& nearest, std::span<const std::int32_t> norms,
                         std::optional<std::int32_t> max_distance, std::optional<double> ratio,
                         MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
  const std::int32_t limit = max_distance.value_or(INT32_MAX);
  for (std::size_t q = 0; q < nearest.queries(); ++q) {
    const std::int32_t norm = norms.empty() ? 0 : norms[q];
    const std::int64_t* found = nearest.ids(q);
    const std::int32_t* found_at = nearest.distances(q);
    const bool accepted = !ratio || nearest.k() < 2 || found[1] < 0 ||
                          found_at[0] + norm < *ratio * *ratio * (found_at[1] + norm);
    for (std::size_t j = 0; j < ids.columns; ++j) {
      const bool reported = accepted && found[j] >= 0 && found_at[j] + norm <= limit;
      ids.row(q)[j] = reported ? found[j] : -1;
      distances.row(q)[j] = reported ? found_at[j] + norm : INT32_MAX;
    }
  }
}

// Throws std::invalid_argument if ids and distances are not (queries x k), k at least 1, or
// max_distance is negative.
inline void check_answer(std::size_t queries, std::optional<std::int32_t> max_distance,
                         const MatrixView<std::int64_t>& ids,
                         const MatrixView<std::int32_t>& distances) {
  if (ids.columns == 0) throw std::invalid_argument("k must be at least 1");
  if (ids.rows != queries || distances.rows != queries || ids.columns != distances.columns) {
    throw std::invalid_argument("ids and distances must be queries x k");
  }
  if (max_distance && *max_distance < 0) {
    throw std::invalid_argument("max_distance must not be negative");
  }
}

}  // namespace protomark
