#include "search/inverted_lists.h"

namespace protomark {
namespace {

// Queries that go through the lists together, so that their visits take little memory.
constexpr size_t kQueries = 1 << 14;

// Every kMinStep-th block of centroids, or fewer, are a sample, the kMaxSampled-th nearest of
// which, or a nearer one, limits the distance.
constexpr size_t kMinStep = 16, kMaxSampled = 64;
// Up to this many lists a heap is faster than selection.
constexpr size_t kFewProbes = 16;
// Queries that are compared with centroids together.
constexpr size_t kBatch = 256;

// The centroids that a query has found: distance in the upper bits, index in the lower ones, so
// that ties go to the smaller index.
using Found = std::vector<int64_t>;

// Selects the lists nearest to a batch of queries, on one thread. (TopK is for a few neighbours;
// these may be hundreds.)
class Selection {
 public:
  // `found` has room for each query of the batch.
  Selection(const PackedPrototypes& centroids, const PreparedCodes& queries, Range batch,
            std::vector<Found>& found)
      : centroids_(centroids),
        scan_(queries, batch),
        limits_(batch.size(), kNoLimit),
        found_(found) {
    for (Found& of_query : found_) of_query.clear();
  }

  void nearest(size_t nprobe, uint32_t* to) {
    guess_limits(nprobe);
    const auto limit_of = [&](size_t q) { return limits_[q]; };
    const auto take = [&](size_t q, int32_t distance, size_t list) {
      found_[q].push_back(int64_t{distance} * (int64_t{1} << 32) + static_cast<int64_t>(list));
    };
    const size_t chunk = scan_.chunk_rows();
    for (size_t row = 0; row < centroids_.rows; row += chunk) {
      compare(row, std::min(chunk, centroids_.rows - row), limit_of, take);
    }
    for (uint32_t q = 0; q < limits_.size(); ++q) {
      if (found_[q].size() < nprobe) {
        found_[q].clear();
        scan_.select({&q, 1});
        compare(
            0, centroids_.rows, [](size_t) { return kNoLimit; },
            [&](size_t, int32_t distance, size_t list) { take(q, distance, list); });
      }
      select(found_[q], nprobe, to + q * nprobe);
    }
  }

 private:
  // Sets limits that probably leave a few more than `nprobe` centroids.
  void guess_limits(size_t nprobe) {
    const size_t step = std::max(kMinStep, nprobe * 3 / 2 / kMaxSampled);
    Neighbours sample(nprobe * 3 / 2 / step + 5, limits_);
    for (size_t row = 0; row < centroids_.rows; row += step * kPackedRows) {
      compare(
          row, std::min(kPackedRows, centroids_.rows - row),
          [&](size_t q) { return sample.limit(q); },
          [&](size_t q, int32_t distance, size_t list) {
            sample[q].offer(distance, static_cast<int64_t>(list));
          });
    }
    for (size_t q = 0; q < limits_.size(); ++q) limits_[q] = sample.limit(q);
  }

  static void select(Found& found, size_t nprobe, uint32_t* to) {
    const auto end = found.begin() + static_cast<std::ptrdiff_t>(nprobe);
    if (nprobe <= kFewProbes) {
      std::partial_sort(found.begin(), end, found.end());
    } else {
      std::nth_element(found.begin(), end - 1, found.end());
      std::iter_swap(found.begin(), std::min_element(found.begin(), end));
    }
    for (size_t i = 0; i < nprobe; ++i) to[i] = static_cast<uint32_t>(found[i]);
  }

  // Compares all queries with centroids from `first` on, a multiple of 16.
  template <typename LimitOf, typename Take>
  void compare(size_t first, size_t n, const LimitOf& limit_of, const Take& take) {
    const auto* codes = static_cast<const int8_t*>(centroids_.data);
    scan_.compare(codes + packed_size(first, centroids_.dim), n, limit_of,
                  [&](size_t q, int32_t distance, size_t i) { take(q, distance, first + i); });
  }

  const PackedPrototypes& centroids_;
  CodeScan scan_;
  std::vector<int32_t> limits_;
  std::vector<Found>& found_;
};

// A query visits a list.
struct Visit {
  uint32_t list;
  uint32_t query;
};

// Returns the visits to a range of each query's `nprobe` nearest lists, sorted by list.
std::vector<Visit> sorted_visits(const std::vector<uint32_t>& nearest, size_t nprobe, Range range,
                                 size_t nlist) {
  const size_t queries = nearest.size() / nprobe;
  std::vector<uint32_t> next(nlist + 1, 0);
  const auto each_visit = [&](const auto& take) {
    for (size_t q = 0; q < queries; ++q) {
      for (size_t p = range.begin; p < range.end; ++p) take(q, nearest[q * nprobe + p]);
    }
  };
  each_visit([&](size_t, uint32_t list) { ++next[list + 1]; });
  for (size_t list = 0; list < nlist; ++list) next[list + 1] += next[list];
  std::vector<Visit> result(queries * range.size());
  each_visit(
      [&](size_t q, uint32_t list) { result[next[list]++] = {list, static_cast<uint32_t>(q)}; });
  return result;
}

void scan_visits(const InvertedLists& lists, std::span<const Visit> visits, PrototypeScan scan) {
  std::vector<uint32_t> blocks, queries;
  for (size_t i = 0; i < visits.size();) {
    const uint32_t list = visits[i].list;
    queries.clear();
    for (; i < visits.size() && visits[i].list == list; ++i) queries.push_back(visits[i].query);
    lists.read(list, blocks);
    scan.scan(queries, blocks, lists.rows(list));
  }
}

}  // namespace

std::vector<uint32_t> nearest_lists(const PackedPrototypes& centroids, const PreparedCodes& queries,
                                    size_t nprobe, int threads) {
  std::vector<uint32_t> result(queries.queries() * nprobe);
  parallel_for(threads, queries.queries(), 16, [&](size_t first, size_t last) {
    std::vector<Found> found(std::min(kBatch, last - first));
    for (size_t q = first; q < last; q += kBatch) {
      Selection(centroids, queries, {q, std::min(last, q + kBatch)}, found)
          .nearest(nprobe, &result[q * nprobe]);
    }
  });
  return result;
}

Matches search_lists(const PackedPrototypes& prototypes, const InvertedLists& lists,
                     const PackedPrototypes& centroids, size_t nprobe, Codes queries, size_t k,
                     const SearchOptions& options) {
  if (nprobe >= lists.nlist()) return search_exact(prototypes, queries, k, options);
  Matches matches = check_search(prototypes.dim, queries, k, options);
  for (size_t begin = 0; begin < queries.rows; begin += kQueries) {
    const size_t n = std::min(kQueries, queries.rows - begin);
    const PreparedCodes prepared({queries.row(begin), n, queries.columns});
    const std::vector<uint32_t> nearest_to =
        nearest_lists(centroids, prepared, nprobe, options.threads);
    Neighbours nearest = prepared.neighbours(k, options);
    // The nearest list goes first, as it leaves little for the others to find.
    for (const Range& range : {Range{0, 1}, Range{1, nprobe}}) {
      const std::vector<Visit> visits = sorted_visits(nearest_to, nprobe, range, lists.nlist());
      run_search(options.threads, Division::of_lists(options.threads, visits.size()), visits.size(),
                 nearest, [&](Range all, Range work, Neighbours& part) {
                   scan_visits(lists, std::span(visits).subspan(work.begin, work.size()),
                               {prototypes, prepared, all, part});
                 });
    }
    write_answer(nearest, prepared.norms(), options, begin, matches);
  }
  return matches;
}

}  // namespace protomark
