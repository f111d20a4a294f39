#include "search/prototype_scan.h"

#include <algorithm>
#include <stdexcept>
#include <string>

namespace protomark {

void PrototypeScan::scan(Range rows) {
  const std::size_t chunk_rows = scan_.chunk_rows();
  for (std::size_t row = rows.begin; row < rows.end; row += chunk_rows) {
    const std::size_t n = std::min(chunk_rows, rows.end - row);
    scan_.choose_prefix(row - rows.begin);
    landmarks_.start_chunk(row, n);
    scan_.compare(
        blocks_.read(row / kPackedRows, (n + kPackedRows - 1) / kPackedRows), n,
        [&](std::size_t q) { return nearest_.limit(q); },
        [&](std::size_t q, std::int32_t distance, std::size_t i) {
          landmarks_.offer(nearest_[q], distance, {static_cast<std::uint32_t>(row + i)});
        });
  }
}

void PrototypeScan::scan(std::span<const std::uint32_t> queries,
                         std::span<const std::uint32_t> blocks, std::size_t rows) {
  constexpr std::size_t kChunk = 32;
  for (std::size_t first = 0; first < blocks.size(); first += kChunk) {
    const auto chunk = blocks.subspan(first, std::min(kChunk, blocks.size() - first));
    const std::size_t n = std::min(chunk.size() * kPackedRows, rows - first * kPackedRows);
    scan_.compare(
        queries, blocks_.read(chunk), n, [&](std::size_t q) { return nearest_.limit(q); },
        [&](std::size_t q, std::int32_t distance, std::size_t i) {
          const std::size_t row = chunk[i / kPackedRows] * kPackedRows + i % kPackedRows;
          landmarks_.offer(nearest_[q], distance, {static_cast<std::uint32_t>(row)});
        });
  }
}

void search_exact(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
                  MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
  check_search(prototypes.dim, queries, options, ids, distances);
  const PreparedCodes prepared(queries);
  Neighbours nearest = prepared.places(ids.columns, options);
  run_search(options.threads, Division::of_rows(options.threads, queries.rows, prototypes.rows),
             prototypes.rows, nearest, [&](Range some, Range rows, Neighbours& part) {
               PrototypeScan(prototypes, prepared, some, part).scan(rows);
             });
  write_answer(nearest, prepared.norms(), options.max_distance, options.ratio, ids, distances);
}

void check_search(std::size_t dim, Codes queries, const SearchOptions& options,
                  const MatrixView<std::int64_t>& ids, const MatrixView<std::int32_t>& distances) {
  if (queries.columns != dim) {
    throw std::invalid_argument("queries have " + std::to_string(queries.columns) +
                                " dimensions, prototypes " + std::to_string(dim));
  }
  if (dim == 0 || dim > 256) {
    throw std::invalid_argument("a code has 1 to 256 dimensions, not " + std::to_string(dim));
  }
  check_answer(queries.rows, options.max_distance, ids, distances);
  if (options.ratio && !(*options.ratio > 0 && *options.ratio <= 1)) {
    throw std::invalid_argument("ratio must be above 0 and at most 1");
  }
}

}  // namespace protomark
