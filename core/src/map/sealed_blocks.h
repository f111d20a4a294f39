// Writes prototypes as a sealed map has them.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "base/bits.h"
#include "base/checked_numbers.h"
#include "base/sq4.h"
#include "file/container.h"
#include "map/sealed_rows.h"
#include "protomark/search.h"

namespace protomark {

// The landmarks of a sealed map, by id, for those of the store that is sealed, in little more than
// a byte per landmark: the id tells which block of 256 a landmark is in.
class SealedLandmarks {
 public:
  explicit SealedLandmarks(const PrototypeStore& store)
      : store_(&store), in_block_(store.ids().size()) {}

  // Takes all landmarks by ascending id.
  void add(LandmarkIndex landmark) {
    if (added_ % kBlock == 0) first_ids_.push_back(store_->id(landmark));
    in_block_[landmark.value] = static_cast<std::uint8_t>(added_++ % kBlock);
  }

  LandmarkIndex operator[](LandmarkIndex landmark) const {
    const auto next = std::ranges::upper_bound(first_ids_, store_->id(landmark));
    const auto block = static_cast<std::size_t>(next - first_ids_.begin()) - 1;
    return {static_cast<std::uint32_t>(block * kBlock + in_block_[landmark.value])};
  }

 private:
  static constexpr std::size_t kBlock = 256;

  const PrototypeStore* store_;
  std::vector<std::uint8_t> in_block_;  // where a landmark is in its block
  std::vector<std::int64_t> first_ids_;
  std::size_t added_ = 0;
};

// Packs blocks of kPackedRows rows as PackedPrototypes has them, or with a scale as
// PackedPrototypes4.
class BlockPacker {
 public:
  // A scale of 0 means 8 bits per number.
  BlockPacker(const SealedRows& rows, int scale) : rows_(&rows), scale_(scale) {
    for (int v = -128; v < 128 && scale_ != 0; ++v) {
      quantized_[static_cast<std::size_t>(v + 128)] = sq4_quantize(v, scale_);
    }
  }

  int scale() const { return scale_; }
  // Bytes per block.
  std::size_t size() const {
    return scale_ == 0 ? packed_size(kPackedRows, rows_->dim())
                       : packed4_size(kPackedRows, rows_->dim());
  }
  // What remains of a number.
  int value(std::int8_t code) const { return scale_ == 0 ? code : sq4_level(u(code), scale_); }

  // `rows` are kPackedRows rows, kNoRow for padding.
  void pack(const Row* rows, std::uint8_t* to) const {
    const std::size_t dim = rows_->dim();
    std::array<std::int8_t, 256> code;
    std::fill_n(to, size(), std::uint8_t{0});
    for (std::size_t i = 0; i < kPackedRows; ++i) {
      if (rows[i] == kNoRow) continue;
      rows_->code(rows[i], code.data());
      for (std::size_t d = 0; d < dim && scale_ == 0; d += 4) {
        std::memcpy(to + packed_index(i, d, dim), &code[d], std::min<std::size_t>(4, dim - d));
      }
      for (std::size_t d = 0; d < dim && scale_ != 0; ++d) {
        std::uint8_t& byte = to[packed4_index(i, d, dim)];
        byte |= static_cast<std::uint8_t>(packed4_high(d) ? u(code[d]) << 4 : u(code[d]));
      }
    }
  }

 private:
  std::uint8_t u(std::int8_t code) const {
    return quantized_[static_cast<std::size_t>(code + 128)];
  }

  const SealedRows* rows_;
  int scale_;
  std::array<std::uint8_t, 256> quantized_{};
};

// Writes rows list after list, each list from a new block on.
class RowWriter {
 public:
  RowWriter(const BlockPacker& packer, const ContainerWriter::Sink& prototypes)
      : packer_(&packer), prototypes_(&prototypes) {}

  // Rows that a sealed map has, padding included.
  static std::size_t row_end(const SealedRows& rows) {
    std::size_t blocks = 0;
    for (std::uint32_t list = 0; list < rows.store().lists().cells(); ++list) {
      blocks += (rows.rows_in(list) + kPackedRows - 1) / kPackedRows;
    }
    return blocks * kPackedRows;
  }

  void add(Row row) {
    block_[filled_++] = row;
    if (filled_ == kPackedRows) end_block();
  }
  void end_list() {
    if (filled_ == 0) return;
    std::fill(block_.begin() + static_cast<std::ptrdiff_t>(filled_), block_.end(), kNoRow);
    end_block();
  }
  void finish() {
    (*prototypes_)(std::as_bytes(std::span(packed_)));
    packed_.clear();
  }

 private:
  static constexpr std::size_t kPiece = 1 << 16;  // bytes

  void end_block() {
    packed_.resize(packed_.size() + packer_->size());
    packer_->pack(block_.data(), packed_.data() + packed_.size() - packer_->size());
    filled_ = 0;
    if (packed_.size() >= kPiece) finish();
  }

  const BlockPacker* packer_;
  const ContainerWriter::Sink* prototypes_;
  std::array<Row, kPackedRows> block_{};
  std::size_t filled_ = 0;
  std::vector<std::uint8_t> packed_;
};

// Writes the owner of each row of a sealed map, in as few bits as its number of landmarks takes;
// padding has that number.
class OwnerWriter {
 public:
  explicit OwnerWriter(std::size_t landmarks) : landmarks_(landmarks), bits_(bits_for(landmarks)) {}

  static int bits_for(std::size_t landmarks) {
    return static_cast<int>(std::bit_width(std::max<std::size_t>(landmarks, 1)));
  }
  // Words of the owners of so many rows.
  std::size_t words(std::size_t rows) const { return packed_words(rows, bits_); }
  const std::vector<std::uint32_t>& checksums() const { return checksums_.all(); }

  void add(LandmarkIndex owner, const ContainerWriter::Sink& sink) { put(owner.value, sink); }
  // Fills a block of rows up with padding.
  void end_list(const ContainerWriter::Sink& sink) {
    while (rows_ % kPackedRows != 0) put(landmarks_, sink);
  }
  void finish(const ContainerWriter::Sink& sink) {
    packer_.align();
    flush(sink);
  }

 private:
  static constexpr std::size_t kPiece = 1 << 13;  // words

  void put(std::uint64_t value, const ContainerWriter::Sink& sink) {
    packer_.add(value, bits_);
    ++rows_;
    if (packer_.words().size() >= kPiece) flush(sink);
  }
  void flush(const ContainerWriter::Sink& sink) {
    checksums_.add(packer_.words());
    sink(std::as_bytes(std::span(packer_.words())));
    packer_.words().clear();
  }

  std::size_t landmarks_;
  int bits_;
  std::size_t rows_ = 0;
  BitPacker packer_;
  BlockChecksums checksums_;
};

}  // namespace protomark
