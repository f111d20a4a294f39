#include "search/scan.h"

namespace protomark {

static_assert(kPackedRows == kernels::kCodeRows);

std::vector<CodeVector> pack_codes(Codes codes) {
  std::vector<CodeVector> result(packed_size(codes.rows, codes.columns) / sizeof(CodeVector));
  auto* to = reinterpret_cast<int8_t*>(result.data());
  for (size_t row = 0; row < codes.rows; ++row) {
    for (size_t d = 0; d < codes.columns; ++d) {
      to[packed_index(row, d, codes.columns)] = codes.row(row)[d];
    }
  }
  return result;
}

void scan_all(const PackedPrototypes& prototypes, const PreparedCodes& queries, int threads,
              Neighbours& nearest) {
  run_search(threads, Division::of_rows(threads, queries.queries(), prototypes.rows),
             prototypes.rows, nearest, [&](Range some, Range rows, Neighbours& part) {
               PrototypeScan(prototypes, queries, some, part).scan(rows);
             });
}

Matches search_exact(const PackedPrototypes& prototypes, Codes queries, size_t k,
                     const SearchOptions& options) {
  return answer(prototypes.dim, queries, k, options, [&](const auto& prepared, auto& nearest) {
    scan_all(prototypes, prepared, options.threads, nearest);
  });
}

Matches answer(size_t dim, Codes queries, size_t k, const SearchOptions& options,
               const std::function<void(const PreparedCodes&, Neighbours&)>& find) {
  constexpr size_t kAtOnce = 1 << 14;
  require(queries.columns == dim, "queries have ", queries.columns, " dimensions, prototypes ",
          dim);
  require(!options.ratio || (*options.ratio > 0 && *options.ratio <= 1),
          "ratio must be above 0 and at most 1");
  Matches matches = room_for_answer(queries.rows, k, options.max_distance);
  for (size_t first = 0; first < queries.rows; first += kAtOnce) {
    const size_t n = std::min(kAtOnce, queries.rows - first);
    const PreparedCodes prepared({queries.row(first), n, queries.columns});
    Neighbours nearest = prepared.neighbours(k, options);
    find(prepared, nearest);
    write_answer(nearest, prepared.norms(), options, first, matches);
  }
  return matches;
}

}  // namespace protomark
