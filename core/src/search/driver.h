// What all searches share: keeps the nearest, divides work among threads, writes the answer.
#pragma once

#include <mutex>

#include "base/parallel.h"
#include "base/text.h"
#include "kernels/kernels.h"
#include "protomark/search.h"

namespace protomark {

// The k nearest that each of several queries has met so far, sorted, ties to the smaller id. Free
// entries have id -1, which counts as larger than all others, and the limit as their distance.
class Neighbours {
 public:
  // A query takes no neighbour beyond its limit.
  Neighbours(size_t k, std::span<const int32_t> limits) : k_(k), ids_(limits.size() * k, -1) {
    distances_.reserve(ids_.size());
    for (const int32_t limit : limits) distances_.insert(distances_.end(), k, limit);
  }

  size_t queries() const { return ids_.size() / k_; }
  size_t k() const { return k_; }
  int32_t limit(size_t query) const { return distances_[query * k_ + k_ - 1]; }
  const int64_t* ids(size_t query) const { return ids_.data() + query * k_; }
  const int32_t* distances(size_t query) const { return distances_.data() + query * k_; }

  // Takes a candidate; if ids come again, its id may be among the nearest, at another distance.
  void offer(size_t query, int32_t distance, int64_t id, bool again) {
    const size_t first = query * k_, last = first + k_ - 1;
    if (!before(distance, id, last)) return;
    size_t i = again ? first : last;
    while (i < last && ids_[i] != id) ++i;
    if (ids_[i] == id && distance >= distances_[i]) return;
    for (; i > first && before(distance, id, i - 1); --i) set(i, distances_[i - 1], ids_[i - 1]);
    set(i, distance, id);
  }

  Neighbours part(Range queries) const {
    Neighbours result(k_, {});
    result.ids_.assign(ids(queries.begin), ids(queries.end));
    result.distances_.assign(distances(queries.begin), distances(queries.end));
    return result;
  }
  // Takes the neighbours of `part`, whose queries begin with `first`.
  void merge(size_t first, const Neighbours& part) {
    for (size_t i = 0; i < part.ids_.size(); ++i) {
      if (part.ids_[i] >= 0) offer(first + i / k_, part.distances_[i], part.ids_[i], true);
    }
  }

 private:
  bool before(int32_t distance, int64_t id, size_t i) const {
    return distance < distances_[i] || (distance == distances_[i] &&
                                        static_cast<uint64_t>(id) < static_cast<uint64_t>(ids_[i]));
  }
  void set(size_t i, int32_t distance, int64_t id) {
    distances_[i] = distance;
    ids_[i] = id;
  }

  size_t k_;
  std::vector<int64_t> ids_;
  std::vector<int32_t> distances_;
};

// Divides a search into ranges of queries times ranges of work (rows, or visits to lists).
struct Division {
  size_t query_ranges = 1;
  size_t work_ranges = 1;

  // Divides the queries first, as those of a range share the reading of each row, and the rows as
  // well if the queries are too few for all threads.
  static Division of_rows(int threads, size_t queries, size_t rows) {
    constexpr size_t kQueries = 64, kRows = 4096;
    if (threads <= 1 || queries == 0) return {};
    const auto n = static_cast<size_t>(threads);
    const size_t query_ranges = std::min(4 * n, divide_up(queries, kQueries));
    const size_t work_ranges = std::min(divide_up(n, query_ranges), divide_up(rows, kRows));
    return {query_ranges, std::max<size_t>(work_ranges, 1)};
  }
  // Divides only the visits, as all queries that visit a list share the reading of it.
  static Division of_lists(int threads, size_t visits) {
    constexpr size_t kVisits = 64;
    if (threads <= 1) return {};
    return {1, std::clamp<size_t>(divide_up(visits, kVisits), 1, 4 * static_cast<size_t>(threads))};
  }

 private:
  static size_t divide_up(size_t a, size_t b) { return (a + b - 1) / b; }
};

// Calls scan(queries, work, neighbours of these queries) for all ranges.
void run_search(int threads, const Division& division, size_t work, Neighbours& nearest,
                const auto& scan) {
  std::mutex mutex;
  const size_t tasks = division.query_ranges * division.work_ranges;
  run_tasks(threads, nearest.queries() == 0 ? 0 : tasks, [&](size_t i) {
    if (tasks == 1) return scan(Range{0, nearest.queries()}, Range{0, work}, nearest);
    const size_t part_of_queries = i / division.work_ranges;
    const Range queries = range_of(nearest.queries(), division.query_ranges, part_of_queries, 16);
    std::unique_lock lock(mutex);
    Neighbours part = nearest.part(queries);
    lock.unlock();
    scan(queries, range_of(work, division.work_ranges, i % division.work_ranges, 16), part);
    lock.lock();
    nearest.merge(queries.begin, part);
  });
}

// Calls take(query, distance, row) for the rows of a chunk within limit_of(query), which `take` may
// tighten. kernel(first, n, limits, &block, hits) scans for n queries from a block on.
void each_hit(size_t n, size_t rows, size_t blocks, const auto& kernel, const auto& limit_of,
              const auto& take) {
  kernels::Hit hits[kernels::kHitRoom];
  int32_t limits[kernels::kScanQueries];
  for (size_t first = 0; first < n; first += kernels::kScanQueries) {
    const size_t group = std::min(kernels::kScanQueries, n - first);
    for (size_t block = 0; block < blocks;) {
      for (size_t i = 0; i < group; ++i) limits[i] = limit_of(first + i);
      const size_t found = kernel(first, group, limits, &block, hits);
      for (size_t i = 0; i < found; ++i) {
        const kernels::Hit& hit = hits[i];
        // Earlier hits may have tightened the limit.
        if (hit.row >= rows || hit.distance > limits[hit.query]) continue;
        take(first + hit.query, hit.distance, hit.row);
        limits[hit.query] = limit_of(first + hit.query);
      }
    }
  }
}

// Writes neighbours to rows of `matches` from `first` on, adding the norms if there are any.
inline void write_answer(const Neighbours& nearest, std::span<const int32_t> norms,
                         const SearchOptions& options, size_t first, Matches& matches) {
  const int32_t limit = options.max_distance.value_or(INT32_MAX);
  const std::optional<double> ratio = options.ratio;
  for (size_t q = 0; q < nearest.queries(); ++q) {
    const int32_t norm = norms.empty() ? 0 : norms[q];
    const int64_t* found = nearest.ids(q);
    const int32_t* found_at = nearest.distances(q);
    const bool accepted = !ratio || nearest.k() < 2 || found[1] < 0 ||
                          found_at[0] + norm < *ratio * *ratio * (found_at[1] + norm);
    for (size_t j = 0; j < matches.ids.columns; ++j) {
      const bool reported = accepted && found[j] >= 0 && found_at[j] + norm <= limit;
      matches.ids.row(first + q)[j] = reported ? found[j] : -1;
      matches.distances.row(first + q)[j] = reported ? found_at[j] + norm : INT32_MAX;
    }
  }
}

// Returns room for an answer. Throws std::invalid_argument for k = 0 or a negative max_distance.
inline Matches room_for_answer(size_t queries, size_t k, std::optional<int32_t> max_distance) {
  require(k != 0, "k must be at least 1");
  require(!max_distance || *max_distance >= 0, "max_distance must not be negative");
  return {{queries, k}, {queries, k}};
}

}  // namespace protomark
