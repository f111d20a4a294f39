#include "search/inverted_lists.h"

#include <cmath>

namespace protomark {
namespace {

// Queries that are compared with centroids together.
constexpr size_t kBatch = 256;

// Selects the lists nearest to each query, on one thread. (Neighbours are for fewer.)
void select_lists(const PackedPrototypes& centroids, const PreparedCodes& queries, Range batch,
                  size_t nprobe, uint32_t* to) {
  CodeScan scan(queries, batch);
  // Compares queries with centroids from `first` on, a multiple of 16.
  const auto compare = [&](size_t first, size_t n, const auto& limit_of, const auto& take) {
    const auto* codes = static_cast<const int8_t*>(centroids.data);
    scan.compare(codes + packed_size(first, centroids.dim), std::min(n, centroids.rows - first),
                 limit_of,
                 [&](size_t q, int32_t distance, size_t i) { take(q, distance, first + i); });
  };
  // Every kMinStep-th block of centroids, or fewer, are a sample, the kMaxSampled-th nearest of
  // which, or a nearer one, is a limit that probably leaves a few more than `nprobe` centroids.
  constexpr size_t kMinStep = 16, kMaxSampled = 64;
  const size_t step = std::max(kMinStep, nprobe * 3 / 2 / kMaxSampled);
  std::vector<int32_t> limits(batch.size(), kNoLimit);
  Neighbours sample(nprobe * 3 / 2 / step + 5, limits);
  for (size_t row = 0; row < centroids.rows; row += step * kPackedRows) {
    compare(
        row, kPackedRows, [&](size_t q) { return sample.limit(q); },
        [&](size_t q, int32_t distance, size_t list) {
          sample.offer(q, distance, static_cast<int64_t>(list), false);
        });
  }
  for (size_t q = 0; q < limits.size(); ++q) limits[q] = sample.limit(q);
  // Distances in the upper bits, indices in the lower ones, so that ties go to smaller indices.
  std::vector<std::vector<int64_t>> all_found(batch.size());
  const auto take = [&](size_t q, int32_t distance, size_t list) {
    all_found[q].push_back(int64_t{distance} * (int64_t{1} << 32) + static_cast<int64_t>(list));
  };
  const size_t chunk = scan.chunk_rows();
  for (size_t row = 0; row < centroids.rows; row += chunk) {
    compare(row, chunk, [&](size_t q) { return limits[q]; }, take);
  }
  for (uint32_t q = 0; q < all_found.size(); ++q) {
    std::vector<int64_t>& found = all_found[q];
    if (found.size() < nprobe) {
      found.clear();
      scan.select({&q, 1});
      compare(
          0, centroids.rows, [](size_t) { return kNoLimit; },
          [&](size_t, int32_t distance, size_t list) { take(q, distance, list); });
    }
    const auto end = found.begin() + static_cast<std::ptrdiff_t>(nprobe);
    std::nth_element(found.begin(), end - 1, found.end());
    std::iter_swap(found.begin(), std::min_element(found.begin(), end));
    for (auto f = found.begin(); f != end; ++f) *to++ = static_cast<uint32_t>(*f);
  }
}

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

// The time to read a row, and to pack one from anywhere, in comparisons of a row and a query.
constexpr double kReading = 40, kPacking = 900;

// Packs some rows anew, of which `kBytes` bytes are in one place: 4 numbers or a word.
template <size_t kBytes>
void pack_rows(const PackedPrototypes& from, std::span<const Row> rows,
               std::vector<CodeVector>& packed) {
  constexpr size_t kAhead = 8;
  const size_t block = packed_size(kPackedRows, from.dim, from.width);
  packed.resize(packed_blocks(rows.size()) * block / sizeof(CodeVector) + 1);
  const auto start = [&](size_t row) {
    return row / kPackedRows * block + row % kPackedRows * kBytes;
  };
  for (size_t i = 0; i < rows.size(); ++i) {
    const auto* source = static_cast<const std::byte*>(from.data);
    if (i + kAhead < rows.size()) {
      const std::byte* next = source + start(rows[i + kAhead].value);
      for (size_t at = 0; at < block; at += sizeof(CodeVector)) __builtin_prefetch(next + at);
    }
    const std::byte* row = source + start(rows[i].value);
    std::byte* to = reinterpret_cast<std::byte*>(packed.data()) + start(i);
    for (size_t at = 0; at < block; at += kPackedRows * kBytes) {
      std::memcpy(to + at, row + at, kBytes);
    }
  }
}

}  // namespace

std::vector<uint32_t> nearest_lists(const PackedPrototypes& centroids, const PreparedCodes& queries,
                                    size_t nprobe, int threads) {
  std::vector<uint32_t> result(queries.queries() * nprobe);
  parallel_for(threads, queries.queries(), 16, [&](size_t first, size_t last) {
    for (size_t q = first; q < last; q += kBatch) {
      select_lists(centroids, queries, {q, std::min(last, q + kBatch)}, nprobe,
                   &result[q * nprobe]);
    }
  });
  return result;
}

Matches search_lists(const PackedPrototypes& prototypes, const InvertedLists& lists,
                     const PackedPrototypes& centroids, size_t nprobe, Codes queries, size_t k,
                     const SearchOptions& options) {
  if (nprobe >= lists.nlist()) return search_exact(prototypes, queries, k, options);
  return answer(prototypes.dim, queries, k, options, [&](const auto& prepared, auto& nearest) {
    const std::vector<uint32_t> nearest_to =
        nearest_lists(centroids, prepared, nprobe, options.threads);
    // The nearest list goes first, as it leaves little for the others to find.
    for (const Range& range : {Range{0, 1}, Range{1, nprobe}}) {
      const std::vector<Visit> visits = sorted_visits(nearest_to, nprobe, range, lists.nlist());
      run_search(options.threads, Division::of_lists(options.threads, visits.size()), visits.size(),
                 nearest, [&](Range all, Range work, Neighbours& part) {
                   scan_visits(lists, std::span(visits).subspan(work.begin, work.size()),
                               {prototypes, prepared, all, part});
                 });
    }
  });
}

Matches search_map(PackedPrototypes prototypes, const InvertedLists& lists,
                   const PackedPrototypes& centroids, const LandmarkRows& landmarks, size_t nprobe,
                   Codes queries, size_t k, const SearchOptions& options) {
  if (!options.among) {
    return search_lists(prototypes, lists, centroids, nprobe, queries, k, options);
  }
  std::vector<LandmarkIndex> some;
  for (const int64_t id : *options.among) some.push_back(landmarks.at(id));
  sort_unique(some);
  const double share =
      static_cast<double>(some.size()) / static_cast<double>(std::max<size_t>(landmarks.end, 1));
  if (options.recall && share > 0) {
    const double wanted = std::ceil(static_cast<double>(nprobe) / share);
    nprobe = wanted < static_cast<double>(lists.nlist()) ? static_cast<size_t>(wanted) : SIZE_MAX;
  }
  const double compared = nprobe < lists.nlist()
                              ? static_cast<double>(nprobe) / static_cast<double>(lists.nlist())
                              : 1.0;
  const auto each = static_cast<double>(queries.rows);
  if (options.nprobe || compared * (kReading + each) < share * (kPacking + each)) {
    std::vector<bool> among(landmarks.end);
    for (const LandmarkIndex landmark : some) among[landmark.value] = true;
    prototypes.landmarks.among = &among;
    return search_lists(prototypes, lists, centroids, nprobe, queries, k, options);
  }
  return answer(prototypes.dim, queries, k, options, [&](const auto& prepared, auto& nearest) {
    // Landmarks are packed some at a time: many beside the work per query, few enough for the
    // cache.
    constexpr size_t kAtOnce = 1 << 14;
    std::vector<CodeVector> packed;
    std::vector<Row> rows;
    std::vector<LandmarkIndex> owners;
    std::vector<int64_t> ids;
    for (size_t first = 0; first < some.size(); first += kAtOnce) {
      rows.clear();
      owners.clear();
      ids.clear();
      for (size_t i = first; i < std::min(some.size(), first + kAtOnce); ++i) {
        landmarks.append(some[i], rows);
        owners.resize(rows.size(), landmark_at(ids.size()));
        const int64_t* all_ids = prototypes.landmarks.ids;
        ids.push_back(all_ids != nullptr ? all_ids[some[i].value] : int64_t{some[i].value});
      }
      (prototypes.width == 0 ? pack_rows<4> : pack_rows<1>)(prototypes, rows, packed);
      PackedPrototypes piece = prototypes;
      piece.data = packed.data();
      piece.rows = rows.size();
      piece.landmarks = {};
      piece.landmarks.of_row = owners.data();
      piece.landmarks.ids = ids.data();
      scan_all(piece, prepared, options.threads, nearest);
    }
  });
}

size_t nprobe_for(const RecallTable& table, double recall, size_t nlist) {
  if (recall >= 1 || table.empty()) return nlist;
  // Two standard errors more, as the share that n test queries show is uncertain.
  const auto n = static_cast<double>(table.size());
  const double enough = n * recall + 2 * std::sqrt(n * recall * (1 - recall));
  if (enough > n) return nlist;
  return table[static_cast<size_t>(std::ceil(enough)) - 1];
}

void check_recall(double recall, size_t nlist, const char* remedy) {
  require(recall > 0 && recall <= 1, "recall must be above 0 and at most 1");
  require(nlist != 0, "recall needs an index: ", remedy);
}

void check_lists(const SearchOptions& options, size_t nlist, const char* remedy) {
  require(!options.recall || !options.nprobe, "recall and nprobe exclude each other");
  if (options.recall) check_recall(*options.recall, nlist, remedy);
  require(!options.nprobe || nlist != 0, "nprobe needs an index: ", remedy);
  require(options.nprobe.value_or(1) != 0, "nprobe must be at least 1");
}

}  // namespace protomark
