// The layout of packed prototypes, in memory as in a sealed file.
#pragma once

#include <functional>

#include "base/rows.h"

namespace protomark {

// Blocks of 16 rows; within a block, for every 4 dimensions, 16 rows x 4 numbers. Zeros pad the
// last block and the last dimensions. Number d of a row is at packed_index.
inline constexpr size_t kPackedRows = 16;

constexpr size_t packed_dim(size_t dim) { return (dim + 3) / 4 * 4; }

constexpr size_t packed_blocks(size_t rows) { return (rows + kPackedRows - 1) / kPackedRows; }

// Bytes of rows; with a `width`, of rows of words of that many numbers.
constexpr size_t packed_size(size_t rows, size_t dim, size_t width = 0) {
  return packed_blocks(rows) * kPackedRows * (width == 0 ? packed_dim(dim) : dim / width);
}

constexpr size_t packed_index(size_t row, size_t d, size_t dim) {
  return row / kPackedRows * packed_size(kPackedRows, dim) + d / 4 * 4 * kPackedRows +
         row % kPackedRows * 4 + d % 4;
}

// The same for word `word` of a row; within a block, there are 16 rows for every word.
constexpr size_t word_index(size_t row, size_t word, size_t words) {
  return (row / kPackedRows * words + word) * kPackedRows + row % kPackedRows;
}

// Codes of 16 rows x 4 dimensions. Unaligned loads would make a scan a quarter slower.
struct alignas(64) CodeVector {
  int8_t codes[4 * kPackedRows];
};

inline std::vector<CodeVector> pack_codes(Codes codes) {
  std::vector<CodeVector> result(packed_size(codes.rows, codes.columns) / sizeof(CodeVector));
  auto* to = reinterpret_cast<int8_t*>(result.data());
  for (size_t row = 0; row < codes.rows; ++row) {
    for (size_t d = 0; d < codes.columns; ++d) {
      to[packed_index(row, d, codes.columns)] = codes.row(row)[d];
    }
  }
  return result;
}

// The landmark of each row: by one of the first two members, or else row i is of landmark i.
struct RowLandmarks {
  const LandmarkIndex* of_row = nullptr;
  std::function<LandmarkIndex(Row)> look_up;
  // Rows of this landmark and of later ones are padding.
  LandmarkIndex end = kNoLandmark;
  // The id of each landmark, negative if its rows are padding. nullptr: ids are indices.
  const int64_t* ids = nullptr;
  // Which landmarks to search; nullptr: all.
  const std::vector<bool>* among = nullptr;
};

struct PackedPrototypes {
  const void* data = nullptr;
  size_t rows = 0;
  size_t dim = 0;
  size_t width = 0;               // numbers per word of a codebook; 0: rows are int8 numbers
  const int8_t* table = nullptr;  // as kernels::Kernels::code_decode takes it
  RowLandmarks landmarks = {};
};

}  // namespace protomark
