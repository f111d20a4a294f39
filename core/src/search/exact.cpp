#include "protomark/search.h"

#include <memory>
#include <numeric>
#include <stdexcept>
#include <string>

#include "base/parallel.h"
#include "kernels/kernels.h"
#include "search/row_landmarks.h"
#include "search/scan.h"
#include "search/search_pieces.h"

namespace protomark {
namespace {

// The landmark of each row where only numbers of rows are known. Rows are asked for chunk after
// chunk.
class RowLandmarkReader {
 public:
  explicit RowLandmarkReader(const RowLandmarks& landmarks) : landmarks_(landmarks) {}

  void start_chunk(std::size_t row, std::size_t rows) {
    chunk_ = row;
    chunk_rows_ = rows;
    of_chunk_.clear();
  }

  std::uint32_t operator[](std::size_t row) {
    if (of_chunk_.empty()) count_chunk();  // most chunks have no hits once neighbours are near
    return of_chunk_[row - chunk_];
  }

 private:
  void count_chunk() {
    const std::uint8_t* rows_of = landmarks_.rows_of;
    while (row_ + rows_of[landmark_] <= chunk_) row_ += rows_of[landmark_++];
    std::uint32_t landmark = landmark_;
    std::size_t end = row_ + rows_of[landmark];
    for (std::size_t row = chunk_; row < chunk_ + chunk_rows_; ++row) {
      if (row == end) end += rows_of[++landmark];
      of_chunk_.push_back(landmark);
    }
  }

  RowLandmarks landmarks_;
  std::size_t chunk_ = 0;
  std::size_t chunk_rows_ = 0;
  std::vector<std::uint32_t> of_chunk_;
  std::uint32_t landmark_ = 0;  // no row of the chunk is of an earlier one
  std::size_t row_ = 0;         // its first
};

// Compares some queries with some rows. What is searched: either kind of packed prototypes, and
// chunk(row, rows, room), which gives int8 codes of some rows, packed as in PackedPrototypes. It
// may put them into `room`.
template <typename Prototypes, typename Chunk>
void scan_rows(const Prototypes& prototypes, const Chunk& chunk, SearchPieces::Range rows,
               CodeScan& scan) {
  std::vector<std::uint32_t> all(scan.queries());
  std::iota(all.begin(), all.end(), 0u);
  std::vector<CodeVector> room;
  RowLandmarkReader landmarks(prototypes.landmarks);
  const RowNumbers numbers(prototypes.landmarks);
  for (std::size_t row = rows.begin; row < rows.end; row += scan.chunk_rows()) {
    const std::size_t n = std::min(scan.chunk_rows(), rows.end - row);
    const std::int8_t* packed = chunk(row, n, room);
    scan.look_at_heads(row - rows.begin);
    if (prototypes.landmarks.rows_of == nullptr) {
      scan.compare(all, packed, n, [&](TopK& best, std::int32_t distance, std::size_t i) {
        numbers.offer(best, distance, row + i, prototypes.ids);
      });
    } else {
      landmarks.start_chunk(row, n);
      scan.compare(all, packed, n, [&](TopK& best, std::int32_t distance, std::size_t i) {
        const std::uint32_t landmark = landmarks[row + i];
        best.offer_distinct(distance, prototypes.ids != nullptr ? prototypes.ids[landmark]
                                                                : std::int64_t{landmark});
      });
    }
  }
}

template <typename Prototypes, typename Chunk>
void search_chunks(const Prototypes& prototypes, const Chunk& chunk, Codes queries,
                   const SearchOptions& options, MatrixView<std::int64_t> ids,
                   MatrixView<float> distances) {
  check_search(prototypes.dim, queries, options, ids, distances);
  if (options.recall || options.probes) {
    throw std::invalid_argument("approximate search needs an index: call build_index first");
  }
  const SearchPieces pieces(options.threads, queries.rows, prototypes.rows);
  const std::size_t row_pieces = pieces.row_pieces();
  std::vector<std::unique_ptr<CodeScan>> scans(pieces.query_pieces() * row_pieces);
  run_tasks(options.threads, scans.size(), [&](std::size_t i) {
    const auto some = pieces.queries(i / row_pieces);
    scans[i] = std::make_unique<CodeScan>(
        Codes{queries.row(some.begin), some.size(), queries.columns}, ids.columns, options);
    scan_rows(prototypes, chunk, pieces.rows(i % row_pieces), *scans[i]);
  });
  for (std::size_t i = 0; i < scans.size(); i += row_pieces) {
    for (std::size_t j = 1; j < row_pieces; ++j) scans[i]->merge(*scans[i + j]);
    const auto some = pieces.queries(i / row_pieces);
    scans[i]->finish({ids.row(some.begin), some.size(), ids.columns},
                     {distances.row(some.begin), some.size(), ids.columns});
  }
}

}  // namespace

void search(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances) {
  const auto chunk = [&](std::size_t row, std::size_t, std::vector<CodeVector>&) {
    return prototypes.data + packed_size(row, prototypes.dim);
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
  const auto chunk = [&](std::size_t row, std::size_t rows, std::vector<CodeVector>& room) {
    room.resize(packed_size(rows, prototypes.dim) / sizeof(CodeVector));
    auto* codes = reinterpret_cast<std::int8_t*>(room.data());
    kernels::active().code_unpack4(prototypes.data + packed4_size(row, prototypes.dim),
                                   (rows + kPackedRows - 1) / kPackedRows, prototypes.dim,
                                   prototypes.half_step, codes);
    return static_cast<const std::int8_t*>(codes);
  };
  search_chunks(prototypes, chunk, queries, options, ids, distances);
}

}  // namespace protomark
