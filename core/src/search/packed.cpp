#include "search/packed.h"

#include <algorithm>
#include <cstring>

#include "kernels/kernels.h"

namespace protomark {

static_assert(kPackedRows == kernels::kCodeRows);

std::vector<CodeVector> pack_codes(Codes codes) {
  std::vector<CodeVector> result(packed_size(codes.rows, codes.columns) / sizeof(CodeVector));
  auto* to = reinterpret_cast<std::int8_t*>(result.data());
  for (std::size_t row = 0; row < codes.rows; ++row) {
    for (std::size_t d = 0; d < codes.columns; ++d) {
      to[packed_index(row, d, codes.columns)] = codes.row(row)[d];
    }
  }
  return result;
}

BlockReader::BlockReader(const PackedPrototypes& prototypes)
    : data_(static_cast<const std::uint8_t*>(prototypes.data)),
      dim_(prototypes.dim),
      scale_(prototypes.scale),
      block_bytes_(scale_ == 0 ? packed_size(kPackedRows, dim_) : packed4_size(kPackedRows, dim_)),
      code_bytes_(packed_size(kPackedRows, dim_)) {}

const std::int8_t* BlockReader::read(std::size_t first_block, std::size_t n) {
  const std::uint8_t* stored = data_ + first_block * block_bytes_;
  if (scale_ == 0) return reinterpret_cast<const std::int8_t*>(stored);
  std::int8_t* codes = room(n);
  copy(first_block, n, codes);
  return codes;
}

const std::int8_t* BlockReader::read(std::span<const std::uint32_t> blocks) {
  bool consecutive = true;
  for (std::size_t i = 1; i < blocks.size(); ++i) {
    consecutive = consecutive && blocks[i] == blocks[i - 1] + 1;
  }
  if (consecutive) return read(blocks[0], blocks.size());
  std::int8_t* codes = room(blocks.size());
  for (std::size_t i = 0; i < blocks.size(); ++i) copy(blocks[i], 1, codes + i * code_bytes_);
  return codes;
}

void BlockReader::copy(std::size_t first_block, std::size_t n, std::int8_t* codes) const {
  const std::uint8_t* stored = data_ + first_block * block_bytes_;
  if (scale_ == 0) {
    std::memcpy(codes, stored, n * block_bytes_);
  } else {
    kernels::active().code_unpack4(stored, n, dim_, scale_, codes);
  }
}

std::int8_t* BlockReader::room(std::size_t blocks) {
  room_.resize(std::max(room_.size(), blocks * code_bytes_ / sizeof(CodeVector)));
  return reinterpret_cast<std::int8_t*>(room_.data());
}

}  // namespace protomark
