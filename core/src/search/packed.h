// Prototypes packed as search reads them, in memory as in a sealed file.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "base/rows.h"
#include "protomark/types.h"

namespace protomark {

// Blocks of 16 rows; within a block, for every 4 dimensions, 16 rows x 4 numbers. The last block
// and the last dimensions are padded with zeros. Number d of a row stands at packed_index.
inline constexpr std::size_t kPackedRows = 16;

constexpr std::size_t packed_dim(std::size_t dim) { return (dim + 3) / 4 * 4; }

constexpr std::size_t packed_size(std::size_t rows, std::size_t dim) {
  return (rows + kPackedRows - 1) / kPackedRows * kPackedRows * packed_dim(dim);
}

constexpr std::size_t packed_index(std::size_t row, std::size_t d, std::size_t dim) {
  return row / kPackedRows * kPackedRows * packed_dim(dim) + d / 4 * 4 * kPackedRows +
         row % kPackedRows * 4 + d % 4;
}

// The same with sq4 numbers (base/sq4.h): for every 8 dimensions, 16 rows x 4 bytes, of which
// byte j holds dimension j in its low bits and dimension 4 + j in its high ones. Number d of a row
// stands in the byte at packed4_index, in the high bits if packed4_high(d).
constexpr std::size_t packed4_size(std::size_t rows, std::size_t dim) {
  return (rows + kPackedRows - 1) / kPackedRows * kPackedRows * ((dim + 7) / 8 * 4);
}

constexpr std::size_t packed4_index(std::size_t row, std::size_t d, std::size_t dim) {
  return row / kPackedRows * kPackedRows * ((dim + 7) / 8 * 4) + d / 8 * 4 * kPackedRows +
         row % kPackedRows * 4 + d % 4;
}

constexpr bool packed4_high(std::size_t d) { return d % 8 >= 4; }

// Codes of 16 rows x 4 dimensions. Aligned: a scan whose loads cross cache lines takes a quarter
// longer.
struct alignas(64) CodeVector {
  std::int8_t codes[4 * kPackedRows];
};

// Packs int8 codes.
std::vector<CodeVector> pack_codes(Codes codes);

// Says which landmark each row is of. At most one of the first three members is set; if none is,
// row i is landmark i.
struct RowLandmarks {
  const LandmarkIndex* of_row = nullptr;
  // Number of rows of each landmark, at least 1; a landmark's rows follow each other.
  const std::uint8_t* row_counts = nullptr;
  std::function<LandmarkIndex(Row)> look_up;
  // Rows of this landmark and of those behind it are padding.
  LandmarkIndex end = kNoLandmark;
  // The id of each landmark, negative if its rows are padding. nullptr: ids are indices.
  const std::int64_t* ids = nullptr;
  // Which landmarks to search; nullptr: all.
  const std::vector<bool>* among = nullptr;
};

struct PackedPrototypes {
  const void* data = nullptr;
  std::size_t rows = 0;
  std::size_t dim = 0;
  int scale = 0;  // of sq4 numbers; 0: numbers are int8
  RowLandmarks landmarks = {};
};

// Reads blocks of prototypes as int8 codes. For one thread.
class BlockReader {
 public:
  explicit BlockReader(const PackedPrototypes& prototypes);

  // Returns the codes of these blocks, one after the other; they are there until the next call. sq4
  // numbers are unpacked into the cache, once for all queries, so that memory is read at 4 bits a
  // number.
  const std::int8_t* read(std::size_t first_block, std::size_t n);
  const std::int8_t* read(std::span<const std::uint32_t> blocks);

 private:
  void copy(std::size_t first_block, std::size_t n, std::int8_t* codes) const;
  std::int8_t* room(std::size_t blocks);

  const std::uint8_t* data_;
  std::size_t dim_;
  int scale_;
  std::size_t block_bytes_;  // as stored
  std::size_t code_bytes_;   // of a block as int8 codes
  std::vector<CodeVector> room_;
};

}  // namespace protomark
