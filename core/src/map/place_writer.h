// Prototypes as a sealed map has them.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <span>
#include <vector>

#include "base/quantize4.h"
#include "file/bit_numbers.h"
#include "file/container.h"
#include "map/landmark_numbers.h"
#include "map/seal_rows.h"
#include "search/packed.h"

namespace protomark {

inline constexpr std::uint32_t kPadding = UINT32_MAX;

// Blocks of kPackedRows rows as PackedPrototypes has them, or with a half-step as
// PackedPrototypes4.
class BlockPacker {
 public:
  BlockPacker(const SealedRows& rows, int half_step) : rows_(&rows), half_step_(half_step) {
    for (std::size_t i = 0; i < quantized_.size() && half_step_ != 0; ++i) {
      quantized_[i] = quantize4(static_cast<int>(i) - 128, half_step_);
    }
  }

  int half_step() const { return half_step_; }
  // Bytes of a block.
  std::size_t size() const {
    const std::size_t dim = rows_->dim();
    return half_step_ == 0 ? packed_size(kPackedRows, dim) : packed4_size(kPackedRows, dim);
  }
  // What is left of a number.
  int value(std::int8_t code) const { return half_step_ == 0 ? code : level4(u(code), half_step_); }

  // `rows` are kPackedRows numbers of rows, or kPadding.
  void pack(const std::uint32_t* rows, std::uint8_t* to) const {
    const std::size_t dim = rows_->dim();
    std::array<std::int8_t, 256> code;
    std::fill_n(to, size(), std::uint8_t{0});
    for (std::size_t i = 0; i < kPackedRows; ++i) {
      if (rows[i] == kPadding) continue;
      rows_->code(rows[i], code.data());
      for (std::size_t d = 0; d < dim && half_step_ == 0; d += 4) {
        std::memcpy(to + packed_index(i, d, dim), &code[d], std::min<std::size_t>(4, dim - d));
      }
      for (std::size_t d = 0; d < dim && half_step_ != 0; ++d) {
        std::uint8_t& byte = to[packed4_index(i, d, dim)];
        byte |= static_cast<std::uint8_t>(packed4_high(d) ? u(code[d]) << 4 : u(code[d]));
      }
    }
  }

 private:
  std::uint8_t u(std::int8_t code) const {
    return quantized_[static_cast<std::uint8_t>(code + 128)];
  }

  const SealedRows* rows_;
  int half_step_;  // 0: 8 bits a number
  std::array<std::uint8_t, 256> quantized_{};
};

// Rows in the order in which they stand in a sealed map: cell after cell, each from a new block on.
class PlaceWriter {
 public:
  // `order`, where there is one, gets the number of the landmark of each place, in so many bits:
  // its id, or what `numbers` says.
  PlaceWriter(const SealedRows& rows, const BlockPacker& packer,
              const ContainerWriter::Sink& prototypes)
      : rows_(&rows), packer_(&packer), prototypes_(&prototypes) {}
  PlaceWriter(const SealedRows& rows, const BlockPacker& packer,
              const ContainerWriter::Sink& prototypes, const ContainerWriter::Sink& order,
              const std::optional<LandmarkNumbers>& numbers, int bits)
      : PlaceWriter(rows, packer, prototypes) {
    order_ = &order;
    numbers_ = &numbers;
    bits_ = bits;
  }

  // As many as the rows take.
  static std::size_t places(const SealedRows& rows) {
    std::size_t blocks = 0;
    for (std::uint32_t c = 0; c < rows.store().blocks().nlist(); ++c) {
      blocks += (rows.rows_in(c) + kPackedRows - 1) / kPackedRows;
    }
    return blocks * kPackedRows;
  }

  void add(std::uint32_t row) {
    block_[filled_++] = row;
    if (filled_ == kPackedRows) end_block();
  }
  void end_cell() {
    if (filled_ == 0) return;
    std::fill(block_.begin() + static_cast<std::ptrdiff_t>(filled_), block_.end(), kPadding);
    end_block();
  }
  void finish() {
    flush();
    if (order_ == nullptr) return;
    const std::vector<std::uint8_t> behind(bit_numbers_size(0, bits_));
    (*order_)(std::as_bytes(std::span(behind)));
  }

 private:
  static constexpr std::size_t kPiece = 1 << 16;  // bytes

  void end_block() {
    packed_.resize(packed_.size() + packer_->size());
    packer_->pack(block_.data(), packed_.data() + packed_.size() - packer_->size());
    for (std::size_t i = 0; i < kPackedRows && order_ != nullptr; ++i) {
      landmarks_.push_back(number(block_[i]));
    }
    filled_ = 0;
    if (packed_.size() >= kPiece) flush();
  }

  std::uint32_t number(std::uint32_t row) const {
    const PrototypeStore& store = rows_->store();
    if (row == kPadding) return static_cast<std::uint32_t>(store.landmarks());
    const std::uint32_t landmark = rows_->landmark_of(row);
    return *numbers_ ? (**numbers_)[landmark] : static_cast<std::uint32_t>(store.ids()[landmark]);
  }

  void flush() {
    (*prototypes_)(std::as_bytes(std::span(packed_)));
    packed_.clear();
    if (order_ == nullptr) return;
    // Of a multiple of 8 numbers, so that pieces follow each other.
    const std::vector<std::uint8_t> numbers = pack_bit_numbers(landmarks_, bits_);
    const std::size_t behind = bit_numbers_size(0, bits_);
    (*order_)(std::as_bytes(std::span(numbers)).first(numbers.size() - behind));
    landmarks_.clear();
  }

  const SealedRows* rows_;
  const BlockPacker* packer_;
  const ContainerWriter::Sink* prototypes_;
  const ContainerWriter::Sink* order_ = nullptr;
  const std::optional<LandmarkNumbers>* numbers_ = nullptr;
  int bits_ = 0;
  std::array<std::uint32_t, kPackedRows> block_{};
  std::size_t filled_ = 0;
  std::vector<std::uint8_t> packed_;
  std::vector<std::uint32_t> landmarks_;  // of each place, as numbers
};

}  // namespace protomark
