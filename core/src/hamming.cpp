#include "protomark/hamming.h"

#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/kernels.h"
#include "parallel.h"
#include "top_k.h"

namespace protomark {
namespace {

using kernels::kWordRows;

// Rows that are packed at a time and then compared with all queries; they stay in the L2 cache.
constexpr std::size_t kChunkRows = 1024;

// Packs rows begin to end as the kernels want them (kernels.h), missing rows as zeros.
void pack(Descriptors database, std::size_t begin, std::size_t end, std::size_t words,
          std::vector<std::uint64_t>& packed) {
  const std::size_t blocks = (end - begin + kWordRows - 1) / kWordRows;
  packed.assign(blocks * kWordRows * words, 0);
  std::vector<std::uint64_t> row(words, 0);
  for (std::size_t i = begin; i < end; ++i) {
    std::memcpy(row.data(), database.row(i), database.columns);
    const std::size_t block = (i - begin) / kWordRows;
    for (std::size_t w = 0; w < words; ++w) {
      packed[(block * words + w) * kWordRows + (i - begin) % kWordRows] = row[w];
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

template <typename Offer>
void search(Descriptors queries, Descriptors database, const HammingOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances, const Offer& offer) {
  check(queries, database, options, ids, distances);
  const auto bits = static_cast<std::int32_t>(8 * queries.columns);
  const std::int32_t limit = std::min(bits, options.max_distance.value_or(bits));
  const std::size_t words = (queries.columns + 7) / 8;
  const kernels::Kernels& kernel = kernels::active();

  parallel_for(options.threads, queries.rows, 16, [&](std::size_t first, std::size_t last) {
    const std::size_t n = last - first;
    std::vector<TopK> best;
    best.reserve(n);
    std::vector<std::uint64_t> query_words(n * words, 0);
    for (std::size_t q = 0; q < n; ++q) {
      best.emplace_back(ids.row(first + q), distances.row(first + q), ids.columns, limit);
      std::memcpy(&query_words[q * words], queries.row(first + q), queries.columns);
    }
    std::vector<std::uint64_t> packed;
    std::vector<kernels::Hit> hits(kernels::kHitRoom);
    std::int32_t limits[kernels::kScanQueries];
    for (std::size_t begin = 0; begin < database.rows; begin += kChunkRows) {
      const std::size_t end = std::min(database.rows, begin + kChunkRows);
      pack(database, begin, end, words, packed);
      const std::size_t blocks = (end - begin + kWordRows - 1) / kWordRows;
      for (std::size_t q = 0; q < n; q += kernels::kScanQueries) {
        const std::size_t group = std::min(kernels::kScanQueries, n - q);
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
    for (std::size_t q = first; q < last; ++q) {
      for (std::size_t j = 0; j < ids.columns; ++j) {
        if (ids.row(q)[j] < 0) distances.row(q)[j] = bits + 1;
      }
    }
  });
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
