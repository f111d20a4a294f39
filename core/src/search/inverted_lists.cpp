#include "search/inverted_lists.h"

#include <algorithm>

namespace protomark {
namespace {

// Queries that go through the lists together; the probes of more would take much memory.
constexpr std::size_t kQueries = 1 << 14;

// A list that a query looks into.
struct Probe {
  std::uint32_t list;
  std::uint32_t query;
};

// Returns those of a range of each query's `nprobe` nearest lists, sorted by list.
std::vector<Probe> sorted_probes(const std::vector<std::uint32_t>& nearest, std::size_t nprobe,
                                 Range range, std::size_t nlist) {
  const std::size_t queries = nearest.size() / nprobe;
  std::vector<std::uint32_t> next(nlist + 1, 0);
  const auto each_probe = [&](const auto& take) {
    for (std::size_t q = 0; q < queries; ++q) {
      for (std::size_t p = range.begin; p < range.end; ++p) take(q, nearest[q * nprobe + p]);
    }
  };
  each_probe([&](std::size_t, std::uint32_t list) { ++next[list + 1]; });
  for (std::size_t list = 0; list < nlist; ++list) next[list + 1] += next[list];
  std::vector<Probe> result(queries * range.size());
  each_probe([&](std::size_t q, std::uint32_t list) {
    result[next[list]++] = {list, static_cast<std::uint32_t>(q)};
  });
  return result;
}

void scan_probes(const InvertedLists& lists, std::span<const Probe> probes, PrototypeScan& scan) {
  std::vector<std::uint32_t> blocks, queries;
  for (std::size_t i = 0; i < probes.size();) {
    const std::uint32_t list = probes[i].list;
    queries.clear();
    for (; i < probes.size() && probes[i].list == list; ++i) queries.push_back(probes[i].query);
    lists.read(list, blocks);
    scan.scan(queries, blocks, lists.rows(list));
  }
}

}  // namespace

void InvertedLists::read(std::uint32_t list, std::vector<std::uint32_t>& blocks) const {
  blocks.clear();
  if (chained_ != nullptr) {
    chained_->append_blocks(list, blocks);
    std::reverse(blocks.begin(), blocks.end());
  } else {
    for (std::uint32_t b = first_blocks_[list]; b < first_blocks_[list + 1]; ++b) {
      blocks.push_back(b);
    }
  }
}

void search_lists(const PackedPrototypes& prototypes, const InvertedLists& lists,
                  const PackedPrototypes& centroids, std::size_t nprobe, Codes queries,
                  const SearchOptions& options, MatrixView<std::int64_t> ids,
                  MatrixView<std::int32_t> distances) {
  if (nprobe >= lists.nlist()) return search_exact(prototypes, queries, options, ids, distances);
  check_search(prototypes.dim, queries, options, ids, distances);
  for (std::size_t begin = 0; begin < queries.rows; begin += kQueries) {
    const std::size_t n = std::min(kQueries, queries.rows - begin);
    const PreparedCodes prepared({queries.row(begin), n, queries.columns});
    const std::vector<std::uint32_t> nearest_to =
        nearest_lists(centroids, prepared, nprobe, options.threads);
    Neighbours nearest = prepared.places(ids.columns, options);
    // The nearest list goes first, as it leaves little for the others to find.
    for (const Range& range : {Range{0, 1}, Range{1, nprobe}}) {
      const std::vector<Probe> probes = sorted_probes(nearest_to, nprobe, range, lists.nlist());
      run_search(options.threads, Division::of_lists(options.threads, probes.size()), probes.size(),
                 nearest, [&](Range all, Range some, Neighbours& part) {
                   PrototypeScan scan(prototypes, prepared, all, part);
                   scan_probes(lists, std::span(probes).subspan(some.begin, some.size()), scan);
                 });
    }
    write_answer(nearest, prepared.norms(), options.max_distance, options.ratio,
                 {ids.row(begin), n, ids.columns}, {distances.row(begin), n, distances.columns});
  }
}

}  // namespace protomark
