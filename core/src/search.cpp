#include "protomark/search.h"

#include <numeric>
#include <stdexcept>
#include <string>

#include "code_scan.h"
#include "kernels/kernels.h"
#include "parallel.h"
#include "row_landmarks.h"

namespace protomark {
namespace {

// Rows that are compared with all queries at a time; codes and landmarks stay in the L1 cache.
constexpr std::size_t kChunkRows = 32 * kPackedRows;

// The landmarks of a map's rows where only their numbers of rows are known, chunk after chunk from
// the first row.
class RowLandmarkCursor {
 public:
  RowLandmarkCursor(const RowLandmarks& landmarks, std::size_t rows)
      : landmarks_(landmarks), end_(rows) {}

  // Those of the next rows, up to kChunkRows.
  const std::uint32_t* next() {
    const std::size_t first = row_;
    row_ = std::min(end_, row_ + kChunkRows);
    room_.resize(kChunkRows);
    for (std::size_t i = 0; i < row_ - first; ++i) {
      room_[i] = landmark_;
      if (++used_ == landmarks_.rows_of[landmark_]) {
        ++landmark_;
        used_ = 0;
      }
    }
    return room_.data();
  }

 private:
  RowLandmarks landmarks_;
  std::size_t end_;
  std::size_t row_ = 0;
  std::uint32_t landmark_ = 0;
  int used_ = 0;  // rows of landmark_ that were given
  std::vector<std::uint32_t> room_;
};

// What is searched: either kind of packed prototypes, and chunk(block, blocks, room), which gives
// int8 codes of some blocks, packed as in PackedPrototypes. It may put them into `room`.
template <typename Prototypes, typename Chunk>
void search_chunks(const Prototypes& prototypes, const Chunk& chunk, Codes queries,
                   const SearchOptions& options, MatrixView<std::int64_t> ids,
                   MatrixView<float> distances) {
  check_search(prototypes.dim, queries, options, ids, distances);
  if (options.recall || options.probes) {
    throw std::invalid_argument("approximate search needs an index: call build_index first");
  }
  parallel_for(options.threads, queries.rows, 16, [&](std::size_t first, std::size_t last) {
    const std::size_t n = last - first;
    const std::size_t k = ids.columns;
    CodeScan scan({queries.row(first), n, queries.columns}, k, options);
    std::vector<std::uint32_t> all(n);
    std::iota(all.begin(), all.end(), 0u);
    std::vector<CodeVector> room;
    const RowNumbers numbers(prototypes.landmarks);
    RowLandmarkCursor cursor(prototypes.landmarks, prototypes.rows);
    for (std::size_t row = 0; row < prototypes.rows; row += kChunkRows) {
      const std::size_t rows = std::min(kChunkRows, prototypes.rows - row);
      const std::int8_t* packed =
          chunk(row / kPackedRows, (rows + kPackedRows - 1) / kPackedRows, room);
      if (prototypes.landmarks.rows_of != nullptr) {
        const std::uint32_t* landmarks = cursor.next();
        scan.compare(all, packed, rows, [&](TopK& best, std::int32_t distance, std::size_t i) {
          const std::uint32_t landmark = landmarks[i];
          best.offer_distinct(distance, prototypes.ids != nullptr ? prototypes.ids[landmark]
                                                                  : std::int64_t{landmark});
        });
      } else {
        scan.compare(all, packed, rows, [&](TopK& best, std::int32_t distance, std::size_t i) {
          numbers.offer(best, distance, row + i, prototypes.ids);
        });
      }
    }
    scan.finish({ids.row(first), n, k}, {distances.row(first), n, k});
  });
}

}  // namespace

void search(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances) {
  const std::size_t block_size = packed_size(kPackedRows, prototypes.dim);
  const auto chunk = [&](std::size_t block, std::size_t, std::vector<CodeVector>&) {
    return prototypes.data + block * block_size;
  };
  search_chunks(prototypes, chunk, queries, options, ids, distances);
}

// A chunk is unpacked once for all queries, into the cache that it would stay in anyway: memory is
// read at 4 bits a number, and the scan is that of int8.
void search(const PackedPrototypes4& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances) {
  if (prototypes.half_step < 1 || prototypes.half_step > kMaxHalfStep) {
    throw std::invalid_argument("a half-step is 1 to " + std::to_string(kMaxHalfStep) + ", not " +
                                std::to_string(prototypes.half_step));
  }
  const std::size_t block_size = packed4_size(kPackedRows, prototypes.dim);
  const auto chunk = [&](std::size_t block, std::size_t blocks, std::vector<CodeVector>& room) {
    room.resize(packed_size(kChunkRows, prototypes.dim) / sizeof(CodeVector));
    auto* codes = reinterpret_cast<std::int8_t*>(room.data());
    kernels::active().code_unpack4(prototypes.data + block * block_size, blocks, prototypes.dim,
                                   prototypes.half_step, codes);
    return static_cast<const std::int8_t*>(codes);
  };
  search_chunks(prototypes, chunk, queries, options, ids, distances);
}

}  // namespace protomark
