#include "search/ivf_search.h"

#include <algorithm>
#include <cstring>
#include <mutex>

#include "base/parallel.h"
#include "kernels/kernels.h"
#include "search/nearest_cells.h"
#include "search/row_landmarks.h"
#include "search/scan.h"

namespace protomark {
namespace {

// Blocks that are compared with all queries of a cell at a time.
constexpr std::size_t kChunkBlocks = 32;
// Queries that go through the cells together.
constexpr std::size_t kQueries = 1 << 14;

// The queries of each cell that has any.
struct Probe {
  std::uint32_t cell;
  std::uint32_t query;
};

bool follow_each_other(const std::uint32_t* blocks, std::size_t n) {
  for (std::size_t i = 1; i < n; ++i) {
    if (blocks[i] != blocks[i - 1] + 1) return false;
  }
  return true;
}

// chunk(blocks, n, room) gives the int8 codes of n blocks one after the other.
template <typename Prototypes, typename Chunk>
void scan_probes(const Prototypes& prototypes, const CellView& cells, const Chunk& chunk,
                 std::span<const Probe> probes, CodeScan& scan) {
  const RowNumbers numbers(prototypes.landmarks);
  std::vector<CodeVector> room;
  std::vector<std::uint32_t> blocks, queries;
  for (std::size_t i = 0; i < probes.size();) {
    const std::uint32_t cell = probes[i].cell;
    queries.clear();
    for (; i < probes.size() && probes[i].cell == cell; ++i) queries.push_back(probes[i].query);
    blocks.clear();
    cells.list(cell, blocks);
    const std::size_t rows = cells.rows(cell);
    for (std::size_t first = 0; first < blocks.size(); first += kChunkBlocks) {
      const std::size_t n = std::min(kChunkBlocks, blocks.size() - first);
      const std::uint32_t* own = &blocks[first];
      const std::size_t own_rows = std::min(n * kPackedRows, rows - first * kPackedRows);
      const std::int8_t* packed = chunk(own, n, room);
      scan.compare(queries, packed, own_rows,
                   [&](TopK& best, std::int32_t distance, std::size_t r) {
                     const std::size_t row =
                         std::size_t{own[r / kPackedRows]} * kPackedRows + r % kPackedRows;
                     numbers.offer(best, distance, row, prototypes.ids);
                   });
    }
  }
}

// Those of [first, last) cells of each query, nearest first, in the order of cells.
std::vector<Probe> by_cell(const std::vector<std::uint32_t>& nearest, std::size_t queries,
                           std::size_t probes, std::size_t first, std::size_t last,
                           std::size_t cells) {
  std::vector<std::uint32_t> next(cells + 1, 0);
  for (std::size_t q = 0; q < queries; ++q) {
    for (std::size_t p = first; p < last; ++p) {
      ++next[nearest[q * probes + p] + 1];
    }
  }
  for (std::size_t c = 0; c < cells; ++c) next[c + 1] += next[c];
  std::vector<Probe> result(queries * (last - first));
  for (std::size_t q = 0; q < queries; ++q) {
    for (std::size_t p = first; p < last; ++p) {
      const std::uint32_t cell = nearest[q * probes + p];
      result[next[cell]++] = {cell, static_cast<std::uint32_t>(q)};
    }
  }
  return result;
}

template <typename Prototypes, typename Chunk>
void search_chunks(const Prototypes& prototypes, const CellView& cells, const Chunk& chunk,
                   const PackedPrototypes& centroids, std::size_t probes, Codes queries,
                   const SearchOptions& options, MatrixView<std::int64_t> ids,
                   MatrixView<float> distances) {
  check_search(prototypes.dim, queries, options, ids, distances);
  probes = std::min(probes, cells.cells());
  // Of more queries the cells would take much memory.
  if (queries.rows > kQueries) {
    for (std::size_t q = 0; q < queries.rows; q += kQueries) {
      const std::size_t n = std::min(kQueries, queries.rows - q);
      search_chunks(prototypes, cells, chunk, centroids, probes,
                    {queries.row(q), n, queries.columns}, options, {ids.row(q), n, ids.columns},
                    {distances.row(q), n, distances.columns});
    }
    return;
  }
  const std::vector<std::uint32_t> nearest =
      nearest_cells(centroids, queries, probes, options.threads);

  CodeScan scan(queries, ids.columns, options);
  // The nearest cell first: it leaves little that others have to offer.
  for (const auto& [first, last] : {std::pair<std::size_t, std::size_t>(0, 1), {1, probes}}) {
    const std::vector<Probe> all =
        by_cell(nearest, queries.rows, probes, first, last, cells.cells());
    if (options.threads == 1) {
      scan_probes(prototypes, cells, chunk, all, scan);
      continue;
    }
    std::mutex mutex;
    parallel_for(options.threads, all.size(), 64, [&](std::size_t begin, std::size_t end) {
      CodeScan own(queries, ids.columns, options);
      {
        const std::scoped_lock lock(mutex);
        own.merge(scan);
      }
      scan_probes(prototypes, cells, chunk, std::span(all).subspan(begin, end - begin), own);
      const std::scoped_lock lock(mutex);
      scan.merge(own);
    });
  }
  scan.finish(ids, distances);
}

}  // namespace

void CellView::list(std::uint32_t cell, std::vector<std::uint32_t>& blocks) const {
  if (chained_ != nullptr) {
    chained_->list(cell, blocks);
    std::reverse(blocks.begin(), blocks.end());
    return;
  }
  for (std::uint32_t b = first_blocks_[cell]; b < first_blocks_[cell + 1]; ++b) blocks.push_back(b);
}

void search_cells(const PackedPrototypes& prototypes, const CellView& cells,
                  const PackedPrototypes& centroids, std::size_t probes, Codes queries,
                  const SearchOptions& options, MatrixView<std::int64_t> ids,
                  MatrixView<float> distances) {
  const std::size_t block_size = packed_size(kPackedRows, prototypes.dim);
  const auto chunk = [&](const std::uint32_t* blocks, std::size_t n,
                         std::vector<CodeVector>& room) -> const std::int8_t* {
    if (follow_each_other(blocks, n)) return prototypes.data + blocks[0] * block_size;
    room.resize(kChunkBlocks * block_size / sizeof(CodeVector));
    auto* codes = reinterpret_cast<std::int8_t*>(room.data());
    for (std::size_t i = 0; i < n; ++i) {
      std::memcpy(codes + i * block_size, prototypes.data + blocks[i] * block_size, block_size);
    }
    return codes;
  };
  search_chunks(prototypes, cells, chunk, centroids, probes, queries, options, ids, distances);
}

void search_cells(const PackedPrototypes4& prototypes, const CellView& cells,
                  const PackedPrototypes& centroids, std::size_t probes, Codes queries,
                  const SearchOptions& options, MatrixView<std::int64_t> ids,
                  MatrixView<float> distances) {
  const std::size_t block_size = packed4_size(kPackedRows, prototypes.dim);
  const std::size_t unpacked_size = packed_size(kPackedRows, prototypes.dim);
  const auto chunk = [&](const std::uint32_t* blocks, std::size_t n,
                         std::vector<CodeVector>& room) -> const std::int8_t* {
    room.resize(kChunkBlocks * unpacked_size / sizeof(CodeVector));
    auto* codes = reinterpret_cast<std::int8_t*>(room.data());
    const std::size_t runs = follow_each_other(blocks, n) ? n : 1;
    for (std::size_t i = 0; i < n; i += runs) {
      kernels::active().code_unpack4(prototypes.data + blocks[i] * block_size, runs, prototypes.dim,
                                     prototypes.half_step, codes + i * unpacked_size);
    }
    return codes;
  };
  search_chunks(prototypes, cells, chunk, centroids, probes, queries, options, ids, distances);
}

}  // namespace protomark
