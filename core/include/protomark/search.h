// Exact nearest prototypes, in integers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "protomark/types.h"

namespace protomark {

class CheckedNumbers;

// Which landmark each row is of, where that is not its number; at most one of the pointers is set.
struct RowLandmarks {
  const std::uint32_t* of_row = nullptr;  // number of the landmark of each row
  // Number of rows of each landmark, at least 1; a landmark's rows follow each other.
  const std::uint8_t* rows_of = nullptr;
  // As a sealed map with an index has them (core/src/base/packed_numbers.h).
  const CheckedNumbers* order = nullptr;
  std::uint32_t end = UINT32_MAX;  // numbers from this on are of no landmark: rows are padding
};

// Prototypes as search reads them and as a sealed map stores them: blocks of 16 rows; within a
// block, for every 4 dimensions, 16 rows x 4 values. The last block and the last dimensions are
// padded with zeros. Value d of row r stands at packed_index(r, d, dim).
struct PackedPrototypes {
  const std::int8_t* data = nullptr;
  std::size_t rows = 0;
  std::size_t dim = 0;
  // Of each landmark; nullptr: its number; negative: there is none, rows are padding.
  const std::int64_t* ids = nullptr;
  RowLandmarks landmarks = {};  // neither is set: a row is a landmark
};

inline constexpr std::size_t kPackedRows = 16;

constexpr std::size_t packed_dim(std::size_t dim) { return (dim + 3) / 4 * 4; }

constexpr std::size_t packed_size(std::size_t rows, std::size_t dim) {
  return (rows + kPackedRows - 1) / kPackedRows * kPackedRows * packed_dim(dim);
}

constexpr std::size_t packed_index(std::size_t row, std::size_t d, std::size_t dim) {
  return row / kPackedRows * kPackedRows * packed_dim(dim) + d / 4 * 4 * kPackedRows +
         row % kPackedRows * 4 + d % 4;
}

// Prototypes of 4 bits a number, as a sealed map may store them: u, 0 to 15, stands for
// half_step * (2 u - 15). Blocks of 16 rows; within a block, for every 8 dimensions, 16 rows x 4
// bytes, of which byte j holds dimension j in its low bits and dimension 4 + j in its
// high ones. The last block and the last dimensions are padded with zeros. Value d of row r stands
// at packed4_index(r, d, dim), in the high bits where packed4_high(d).
struct PackedPrototypes4 {
  const std::uint8_t* data = nullptr;
  std::size_t rows = 0;
  std::size_t dim = 0;
  int half_step = 1;                  // 1 to kMaxHalfStep
  const std::int64_t* ids = nullptr;  // as in PackedPrototypes
  RowLandmarks landmarks = {};
};

inline constexpr int kMaxHalfStep = 8;  // 15 * 8 is the last multiple of 15 that int8 holds

constexpr std::size_t packed4_size(std::size_t rows, std::size_t dim) {
  return (rows + kPackedRows - 1) / kPackedRows * kPackedRows * ((dim + 7) / 8 * 4);
}

constexpr std::size_t packed4_index(std::size_t row, std::size_t d, std::size_t dim) {
  return row / kPackedRows * kPackedRows * ((dim + 7) / 8 * 4) + d / 8 * 4 * kPackedRows +
         row % kPackedRows * 4 + d % 4;
}

constexpr bool packed4_high(std::size_t d) { return d % 8 >= 4; }

struct SearchOptions {
  // Approximate search in a map with an index: as many of the cells nearest to the query are
  // searched as bring this recall, above 0 and at most 1; or `probes` cells, at least 1. At most
  // one of these is set; none: all prototypes are searched.
  std::optional<double> recall;
  std::optional<std::size_t> probes;
  // Neighbours further away than this (Euclidean, in code units) are not reported.
  std::optional<float> max_distance;
  // Lowe's ratio test: a query keeps its neighbours only where its nearest landmark is closer than
  // `ratio` times the second nearest landmark, or where there is no second. In (0, 1].
  std::optional<float> ratio;
  int threads = 1;
};

// The k nearest landmarks of each query code, nearest first, ties to the smaller id. A landmark is
// as far away as the nearest of its prototypes.
//
// ids and distances are (queries x k), k = ids.columns. Distances are Euclidean, in code units: the
// float nearest to the root of the integer squared distance. Where there is no neighbour the id is
// -1 and the distance infinite. Throws std::invalid_argument where shapes or options do not fit;
// there is no index here.
void search(const PackedPrototypes& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances);
void search(const PackedPrototypes4& prototypes, Codes queries, const SearchOptions& options,
            MatrixView<std::int64_t> ids, MatrixView<float> distances);

}  // namespace protomark
