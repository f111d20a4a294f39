// What exact, inverted-list and Hamming search share: how they are divided among threads, their
// loop over the hits of a kernel, and how they write their answer.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <optional>
#include <span>

#include "base/parallel.h"
#include "base/text.h"
#include "kernels/kernels.h"
#include "protomark/search.h"
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
  // Divides only the visits to lists, as all queries that visit a list share the reading of it.
  static Division of_lists(int threads, std::size_t visits) {
    constexpr std::size_t kVisits = 64;
    if (threads <= 1) return {};
    return {1, std::clamp<std::size_t>(divide_up(visits, kVisits), 1,
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

// Writes the neighbours to rows of `matches`, from `first` on. `norms`, if there are any, are added
// to the distances of each query.
inline void write_answer(const Neighbours& nearest, std::span<const std::int32_t> norms,
                         const SearchOptions& options, std::size_t first, Matches& matches) {
  const std::int32_t limit = options.max_distance.value_or(INT32_MAX);
  const std::optional<double> ratio = options.ratio;
  for (std::size_t q = 0; q < nearest.queries(); ++q) {
    const std::int32_t norm = norms.empty() ? 0 : norms[q];
    const std::int64_t* found = nearest.ids(q);
    const std::int32_t* found_at = nearest.distances(q);
    const bool accepted = !ratio || nearest.k() < 2 || found[1] < 0 ||
                          found_at[0] + norm < *ratio * *ratio * (found_at[1] + norm);
    for (std::size_t j = 0; j < matches.ids.columns; ++j) {
      const bool reported = accepted && found[j] >= 0 && found_at[j] + norm <= limit;
      matches.ids.row(first + q)[j] = reported ? found[j] : -1;
      matches.distances.row(first + q)[j] = reported ? found_at[j] + norm : INT32_MAX;
    }
  }
}

// Returns room for the answer of a search. Throws std::invalid_argument if k is 0 or max_distance
// is negative.
inline Matches room_for_answer(std::size_t queries, std::size_t k,
                               std::optional<std::int32_t> max_distance) {
  if (k == 0) invalid("k must be at least 1");
  if (max_distance && *max_distance < 0) invalid("max_distance must not be negative");
  return {{queries, k}, {queries, k}};
}

}  // namespace protomark
