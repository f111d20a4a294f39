#include "protomark/hamming.h"

#include <algorithm>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/parallel.h"
#include "kernels/kernels.h"
#include "search/search_pieces.h"
#include "search/top_k.h"

namespace protomark {
namespace {

using kernels::kWordRows;

// Bytes of descriptors that are packed at a time and then compared with all queries; they stay in
// the L1 cache.
constexpr std::size_t kChunkBytes = 16384;

// Packs rows begin to end as the kernels want them (kernels.h), missing rows as zeros.
void pack(Descriptors database, std::size_t begin, std::size_t end, std::size_t words,
          std::uint64_t* packed) {
  const std::size_t rest = database.columns % 8;
  for (std::size_t row = begin; row < end; row += kWordRows, packed += kWordRows * words) {
    if (end - row < kWordRows) std::fill_n(packed, kWordRows * words, 0);
    for (std::size_t r = 0; r < std::min(kWordRows, end - row); ++r) {
      const std::uint8_t* bytes = database.row(row + r);
      for (std::size_t w = 0; w < database.columns / 8; ++w) {
        std::memcpy(&packed[w * kWordRows + r], bytes + 8 * w, 8);
      }
      if (rest == 0) continue;
      std::uint64_t last = 0;
      std::memcpy(&last, bytes + database.columns - rest, rest);
      packed[(words - 1) * kWordRows + r] = last;
    }
  }
}

void check(Descriptors queries, Descriptors database, const HammingOptions& options,
           const MatrixView<std::int64_t>& ids, const MatrixView<std::int32_t>& distances) {
  if (queries.columns != database.columns) {
    throw std::invalid_argument("queries have " + std::to_string(queries.columns) +
                                " bytes, the database has " + std::to_string(database.columns));
  }
  if (queries.columns == 0 || queries.columns > 4096) {
    throw std::invalid_argument("a descriptor has 1 to 4096 bytes, not " +
                                std::to_string(queries.columns));
  }
  if (database.rows > UINT32_MAX) throw std::invalid_argument("the database has over 2^32 rows");
  if (ids.columns == 0) throw std::invalid_argument("k must be at least 1");
  if (ids.rows != queries.rows || distances.rows != queries.rows ||
      ids.columns != distances.columns) {
    throw std::invalid_argument("ids and distances must be queries x k");
  }
  if (options.max_distance && *options.max_distance < 0) {
    throw std::invalid_argument("max_distance must not be negative");
  }
}

// What some queries have found so far.
struct Nearest {
  std::vector<std::int64_t> ids;
  std::vector<std::int32_t> distances;
  std::vector<TopK> best;

  Nearest(std::size_t n, std::size_t k, std::int32_t limit) : ids(n * k), distances(n * k) {
    best.reserve(n);
    for (std::size_t i = 0; i < n; ++i) {
      best.emplace_back(&ids[i * k], &distances[i * k], k, limit);
    }
  }

  void merge(const Nearest& other) {
    const std::size_t k = best.empty() ? 1 : ids.size() / best.size();
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (other.ids[i] >= 0) best[i / k].offer_distinct(other.distances[i], other.ids[i]);
    }
  }
};

// Compares all queries with rows begin to end of the database.
template <typename Offer>
void scan_rows(Descriptors queries, Descriptors database, SearchPieces::Range rows,
               std::vector<TopK>& best, const Offer& offer) {
  const kernels::Kernels& kernel = kernels::active();
  const std::size_t words = (queries.columns + 7) / 8;
  std::vector<std::uint64_t> query_words(queries.rows * words, 0);
  for (std::size_t q = 0; q < queries.rows; ++q) {
    std::memcpy(&query_words[q * words], queries.row(q), queries.columns);
  }
  const std::size_t chunk_blocks = std::max<std::size_t>(kChunkBytes / (8 * words * kWordRows), 1);
  std::vector<std::uint64_t> packed(chunk_blocks * kWordRows * words);
  std::vector<kernels::Hit> hits(kernels::kHitRoom);
  std::int32_t limits[kernels::kScanQueries];
  for (std::size_t begin = rows.begin; begin < rows.end; begin += chunk_blocks * kWordRows) {
    const std::size_t end = std::min(rows.end, begin + chunk_blocks * kWordRows);
    pack(database, begin, end, words, packed.data());
    const std::size_t blocks = (end - begin + kWordRows - 1) / kWordRows;
    for (std::size_t q = 0; q < queries.rows; q += kernels::kScanQueries) {
      const std::size_t group = std::min(kernels::kScanQueries, queries.rows - q);
      for (std::size_t block = 0; block < blocks;) {
        for (std::size_t i = 0; i < group; ++i) limits[i] = best[q + i].limit();
        const std::size_t found =
            kernel.hamming_scan({&query_words[q * words], limits, group},
                                {packed.data(), blocks, words}, &block, hits.data());
        for (std::size_t i = 0; i < found; ++i) {
          const std::size_t row = begin + hits[i].row;
          if (row < end) offer(best[q + hits[i].query], hits[i].distance, row);
        }
      }
    }
  }
}

template <typename Offer>
void search(Descriptors queries, Descriptors database, const HammingOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances, const Offer& offer) {
  check(queries, database, options, ids, distances);
  const auto bits = static_cast<std::int32_t>(8 * queries.columns);
  const std::int32_t limit = std::min(bits, options.max_distance.value_or(bits));
  const std::size_t k = ids.columns;
  const SearchPieces pieces(options.threads, queries.rows, database.rows);
  const std::size_t row_pieces = pieces.row_pieces();
  std::vector<std::unique_ptr<Nearest>> nearest(pieces.query_pieces() * row_pieces);
  run_tasks(options.threads, nearest.size(), [&](std::size_t i) {
    const auto some = pieces.queries(i / row_pieces);
    nearest[i] = std::make_unique<Nearest>(some.size(), k, limit);
    scan_rows({queries.row(some.begin), some.size(), queries.columns}, database,
              pieces.rows(i % row_pieces), nearest[i]->best, offer);
  });
  for (std::size_t i = 0; i < nearest.size(); i += row_pieces) {
    Nearest& all = *nearest[i];
    for (std::size_t j = 1; j < row_pieces; ++j) all.merge(*nearest[i + j]);
    const auto some = pieces.queries(i / row_pieces);
    std::copy(all.ids.begin(), all.ids.end(), ids.row(some.begin));
    std::transform(all.ids.begin(), all.ids.end(), all.distances.begin(), distances.row(some.begin),
                   [&](std::int64_t id, std::int32_t d) { return id < 0 ? bits + 1 : d; });
  }
}

}  // namespace

void hamming_search(Descriptors queries, Descriptors database, const HammingOptions& options,
                    MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
  search(queries, database, options, ids, distances,
         [](TopK& best, std::int32_t distance, std::size_t row) {
           best.offer(distance, static_cast<std::int64_t>(row));
         });
}

void hamming_search(Descriptors queries, Descriptors database,
                    std::span<const std::int64_t> landmarks, const HammingOptions& options,
                    MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
  if (landmarks.size() != database.rows) {
    throw std::invalid_argument("the database has " + std::to_string(database.rows) +
                                " rows, landmarks has " + std::to_string(landmarks.size()));
  }
  for (const std::int64_t id : landmarks) {
    if (id < 0) throw std::invalid_argument("landmark ids must not be negative");
  }
  search(queries, database, options, ids, distances,
         [&](TopK& best, std::int32_t distance, std::size_t row) {
           best.offer_distinct(distance, landmarks[row]);
         });
}

}  // namespace protomark
