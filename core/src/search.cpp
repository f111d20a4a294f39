#include "protomark/search.h"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

#include "kernels/kernels.h"
#include "parallel.h"
#include "top_k.h"

namespace protomark {
namespace {

static_assert(kPackedRows == kernels::kCodeRows);

// Blocks that are compared with all queries at a time; they stay in the L1 cache (32 dimensions).
constexpr std::size_t kChunkBlocks = 32;
constexpr std::size_t kChunkRows = kChunkBlocks * kPackedRows;

// Squared distances reach 256 * 254^2 < 2^24, which float holds exactly; this is beyond all.
constexpr std::int32_t kNoLimit = 1 << 25;

void check(std::size_t dim, Codes queries, const SearchOptions& options,
           const MatrixView<std::int64_t>& ids, const MatrixView<float>& distances) {
  if (queries.columns != dim) {
    throw std::invalid_argument("queries have " + std::to_string(queries.columns) +
                                " dimensions, prototypes " + std::to_string(dim));
  }
  if (dim == 0 || dim > 256) {
    throw std::invalid_argument("a code has 1 to 256 dimensions, not " + std::to_string(dim));
  }
  if (ids.columns == 0) throw std::invalid_argument("k must be at least 1");
  if (ids.rows != queries.rows || distances.rows != queries.rows ||
      ids.columns != distances.columns) {
    throw std::invalid_argument("ids and distances must be queries x k");
  }
  if (options.max_distance && !(*options.max_distance >= 0)) {
    throw std::invalid_argument("max_distance must not be negative");
  }
  if (options.ratio && !(*options.ratio > 0 && *options.ratio <= 1)) {
    throw std::invalid_argument("ratio must be above 0 and at most 1");
  }
}

std::int32_t squared_norm(const std::int8_t* code, std::size_t dim) {
  std::int32_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += code[d] * code[d];
  return sum;
}

// Whether a squared distance is within the limits; doubles hold all values exactly enough that the
// answer is the same on every machine.
bool within(std::int32_t squared, float max_distance) {
  return static_cast<double>(squared) <= static_cast<double>(max_distance) * max_distance;
}

bool distinct(std::int32_t nearest, std::int32_t second, float ratio) {
  return static_cast<double>(nearest) < static_cast<double>(ratio) * ratio * second;
}

// The landmarks of a map's rows, chunk after chunk from the first row.
class RowLandmarkCursor {
 public:
  RowLandmarkCursor(const RowLandmarks& landmarks, std::size_t rows)
      : landmarks_(landmarks), end_(rows) {}

  // Those of the next rows, up to kChunkRows; nullptr where a row is a landmark.
  const std::uint32_t* next() {
    const std::size_t first = row_;
    row_ = std::min(end_, row_ + kChunkRows);
    if (landmarks_.of_row != nullptr) return landmarks_.of_row + first;
    if (landmarks_.rows_of == nullptr) return nullptr;
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

// Codes of 16 landmarks x 4 dimensions. Aligned: a scan whose loads cross cache lines takes a
// quarter longer.
struct alignas(64) Vector {
  std::int8_t codes[64];
};

// What is searched: either kind of packed prototypes, and chunk(block, blocks, room), which gives
// int8 codes of some blocks, packed as in PackedPrototypes. It may put them into `room`.
template <typename Prototypes, typename Chunk>
void search_chunks(const Prototypes& prototypes, const Chunk& chunk, Codes queries,
                   const SearchOptions& options, MatrixView<std::int64_t> ids,
                   MatrixView<float> distances) {
  check(prototypes.dim, queries, options, ids, distances);
  const std::size_t dim = packed_dim(prototypes.dim);
  const std::size_t all_blocks = (prototypes.rows + kPackedRows - 1) / kPackedRows;
  const std::size_t k = ids.columns;
  // The ratio test needs the second nearest even where the caller wants one.
  const std::size_t kept = options.ratio ? std::max<std::size_t>(k, 2) : k;
  const kernels::Kernels& kernel = kernels::active();

  parallel_for(options.threads, queries.rows, 16, [&](std::size_t first, std::size_t last) {
    const std::size_t n = last - first;
    std::vector<std::int64_t> best_ids(n * kept);
    std::vector<std::int32_t> best_distances(n * kept);
    std::vector<std::uint8_t> unsigned_queries(n * dim, 128);
    std::vector<TopK> best;
    best.reserve(n);
    for (std::size_t q = 0; q < n; ++q) {
      const std::int8_t* code = queries.row(first + q);
      for (std::size_t d = 0; d < prototypes.dim; ++d) {
        unsigned_queries[q * dim + d] = static_cast<std::uint8_t>(code[d] + 128);
      }
      best.emplace_back(&best_ids[q * kept], &best_distances[q * kept], kept, kNoLimit);
    }

    // The kernels leave out the query's own norm, which does not change the order; it is added
    // where distances are given back.
    std::vector<Vector> room;
    std::vector<std::int32_t> offsets(kChunkRows);
    std::vector<std::uint32_t> hit_rows(kChunkRows);
    std::vector<std::int32_t> hit_distances(kChunkRows);
    RowLandmarkCursor cursor(prototypes.landmarks, prototypes.rows);
    const auto id = [&](std::size_t landmark) {
      return prototypes.ids != nullptr ? prototypes.ids[landmark]
                                       : static_cast<std::int64_t>(landmark);
    };
    for (std::size_t block = 0; block < all_blocks; block += kChunkBlocks) {
      const std::size_t blocks = std::min(kChunkBlocks, all_blocks - block);
      const std::int8_t* packed = chunk(block, blocks, room);
      kernel.code_offsets(packed, blocks, dim, offsets.data());
      const std::uint32_t* landmarks = cursor.next();
      for (std::size_t q = 0; q < n; ++q) {
        const std::size_t found =
            kernel.code_scan(&unsigned_queries[q * dim], packed, blocks, dim, offsets.data(),
                             best[q].limit(), {hit_rows.data(), hit_distances.data()});
        for (std::size_t i = 0; i < found; ++i) {
          const std::size_t row = block * kPackedRows + hit_rows[i];
          if (row >= prototypes.rows) continue;
          if (landmarks == nullptr) {
            best[q].offer(hit_distances[i], id(row));
          } else {
            best[q].offer_distinct(hit_distances[i], id(landmarks[hit_rows[i]]));
          }
        }
      }
    }

    for (std::size_t q = 0; q < n; ++q) {
      const std::int32_t norm = squared_norm(queries.row(first + q), prototypes.dim);
      const std::int64_t* found_ids = &best_ids[q * kept];
      const std::int32_t* found = &best_distances[q * kept];
      const bool keep = !options.ratio || kept < 2 || found_ids[1] < 0 ||
                        distinct(found[0] + norm, found[1] + norm, *options.ratio);
      for (std::size_t j = 0; j < k; ++j) {
        const bool valid =
            keep && found_ids[j] >= 0 &&
            (!options.max_distance || within(found[j] + norm, *options.max_distance));
        ids.row(first + q)[j] = valid ? found_ids[j] : -1;
        distances.row(first + q)[j] = valid ? std::sqrt(static_cast<float>(found[j] + norm))
                                            : std::numeric_limits<float>::infinity();
      }
    }
  });
}

}  // namespace

void search(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances) {
  const std::size_t block_size = packed_size(kPackedRows, prototypes.dim);
  const auto chunk = [&](std::size_t block, std::size_t, std::vector<Vector>&) {
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
  const auto chunk = [&](std::size_t block, std::size_t blocks, std::vector<Vector>& room) {
    room.resize(packed_size(kChunkRows, prototypes.dim) / sizeof(Vector));
    auto* codes = reinterpret_cast<std::int8_t*>(room.data());
    kernels::active().code_unpack4(prototypes.data + block * block_size, blocks, prototypes.dim,
                                   prototypes.half_step, codes);
    return static_cast<const std::int8_t*>(codes);
  };
  search_chunks(prototypes, chunk, queries, options, ids, distances);
}

}  // namespace protomark
