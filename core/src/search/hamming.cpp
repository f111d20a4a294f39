#include "protomark/hamming.h"

#include <cstring>

#include "search/driver.h"

namespace protomark {
namespace {

using kernels::kWordRows;

// Packs rows as kernels::PackedWords, the last word of each padded with zeros.
void pack(Descriptors database, Range rows, size_t words, uint64_t* packed) {
  const size_t rest = database.columns % 8;
  for (size_t i = 0; i < rows.size(); ++i) {
    const uint8_t* bytes = database.row(rows.begin + i);
    uint64_t* to = packed + i / kWordRows * kWordRows * words + i % kWordRows;
    for (size_t w = 0; w < database.columns / 8; ++w, to += kWordRows) {
      std::memcpy(to, bytes + 8 * w, 8);
    }
    if (rest != 0) {
      *to = 0;
      std::memcpy(to, bytes + database.columns - rest, rest);
    }
  }
}

void check(Descriptors queries, Descriptors database, const HammingOptions& options) {
  require(queries.columns == database.columns, "queries have ", queries.columns,
          " bytes, the database has ", database.columns);
  require(queries.columns >= 1 && queries.columns <= 4096, "a descriptor has 1 to 4096 bytes, not ",
          queries.columns);
  require(database.rows <= UINT32_MAX, "the database has over 2^32 rows");
  if (!options.landmarks) return;
  const std::span<const int64_t> landmarks = *options.landmarks;
  require(landmarks.size() == database.rows, "the database has ", database.rows,
          " rows, landmarks has ", landmarks.size());
  require(std::ranges::all_of(landmarks, [](int64_t id) { return id >= 0; }),
          "landmark ids must not be negative");
}

// Compares queries with some rows, whose landmarks are nullptr if ids are rows.
void scan(Descriptors queries, Descriptors database, Range rows, const int64_t* landmarks,
          Neighbours& nearest) {
  // Bytes that are packed and then compared with all queries, from the L1 cache.
  constexpr size_t kChunkBytes = 16384;
  const size_t words = (queries.columns + 7) / 8;
  std::vector<uint64_t> query_words(queries.rows * words, 0);
  for (size_t q = 0; q < queries.rows; ++q) {
    std::memcpy(&query_words[q * words], queries.row(q), queries.columns);
  }
  const size_t blocks = std::max<size_t>(kChunkBytes / (8 * words * kWordRows), 1);
  std::vector<uint64_t> packed(blocks * kWordRows * words);
  for (size_t begin = rows.begin; begin < rows.end; begin += blocks * kWordRows) {
    const Range chunk{begin, std::min(rows.end, begin + blocks * kWordRows)};
    pack(database, chunk, words, packed.data());
    const kernels::PackedWords packed_rows{packed.data(),
                                           (chunk.size() + kWordRows - 1) / kWordRows, words};
    each_hit(
        queries.rows, chunk.size(), packed_rows.blocks,
        [&](size_t first, size_t n, const int32_t* limits, size_t* block, kernels::Hit* found) {
          return kernels::active().hamming_scan({&query_words[first * words], limits, n},
                                                packed_rows, block, found);
        },
        [&](size_t q) { return nearest.limit(q); },
        [&](size_t q, int32_t distance, size_t row) {
          const size_t at = begin + row;
          const bool again = landmarks != nullptr;
          nearest.offer(q, distance, again ? landmarks[at] : static_cast<int64_t>(at), again);
        });
  }
}

}  // namespace

Matches hamming_search(Descriptors queries, Descriptors database, size_t k,
                       const HammingOptions& options) {
  check(queries, database, options);
  Matches matches = room_for_answer(queries.rows, k, options.max_distance);
  const int64_t* landmarks = options.landmarks ? options.landmarks->data() : nullptr;
  const auto bits = static_cast<int32_t>(8 * queries.columns);
  const std::vector<int32_t> limits(queries.rows,
                                    std::min(bits, options.max_distance.value_or(bits)));
  Neighbours nearest(k, limits);
  run_search(options.threads, Division::of_rows(options.threads, queries.rows, database.rows),
             database.rows, nearest, [&](Range range, Range rows, Neighbours& part) {
               scan({queries.row(range.begin), range.size(), queries.columns}, database, rows,
                    landmarks, part);
             });
  write_answer(nearest, {}, {}, 0, matches);
  return matches;
}

}  // namespace protomark
