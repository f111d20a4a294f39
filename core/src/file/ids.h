// The ascending ids of a map's landmarks, in little space and with random access.
#pragma once

#include <bit>

#include "base/rows.h"
#include "file/sections.h"

namespace protomark {

// Landmark j of a block has the id first_id + j + gap j, where gap j counts the ids missing up to
// there. Ids without gaps take no bits.
struct IdBlock {
  int64_t first_id;
  uint64_t gaps;  // 64 * their first word + bits per gap, 0 to 63

  int bits() const { return static_cast<int>(gaps % 64); }
  size_t first_word() const { return gaps / 64; }
};
inline constexpr size_t kIdBlock = 128;  // landmarks; the last block may have fewer

// Writes the sections `idblocks` and `idgaps` from ascending ids.
class IdBlockWriter {
 public:
  explicit IdBlockWriter(ContainerWriter::Writers& to)
      : blocks_(to[section::kIdBlocks]), gaps_(to[section::kIdGaps]) {}

  void add(int64_t id) {
    ids_.push_back(id);
    if (ids_.size() == kIdBlock) end_block();
  }
  void finish() {
    if (!ids_.empty()) end_block();
  }

  // Whether ids have to be stored: 0 to n - 1 have not.
  static bool needed(size_t n, int64_t largest) { return largest + 1 != static_cast<int64_t>(n); }
  // Adds the two sections as the last of several that are produced side by side.
  static void add_to(std::vector<ContainerWriter::Part>& parts, size_t n) {
    parts.push_back({section::kIdBlocks, (n + kIdBlock - 1) / kIdBlock * sizeof(IdBlock)});
    parts.push_back({section::kIdGaps, ContainerWriter::kUnknownSize});
  }

 private:
  void end_block() {
    const auto gap = [&](size_t j) { return static_cast<uint64_t>(ids_[j] - ids_.front()) - j; };
    const auto bits = static_cast<int>(std::bit_width(gap(ids_.size() - 1)));
    blocks_.add(IdBlock{ids_.front(), words_ * 64 + static_cast<uint64_t>(bits)});
    for (size_t j = 0; j < ids_.size(); ++j) gaps_.add(gap(j), bits);
    gaps_.align();
    words_ += packed_words(ids_.size(), bits);
    ids_.clear();
  }

  ValueWriter &blocks_, &gaps_;
  std::vector<int64_t> ids_;  // of the block
  size_t words_ = 0;          // of all gaps
};

class LandmarkIds {
 public:
  LandmarkIds() = default;
  // Checks all but gaps, which are checked as they are read from `file`. Throws FileError.
  LandmarkIds(const ContainerReader& file, size_t n) : file_(&file), n_(n) {
    if (!file.has(section::kIdBlocks)) return;
    const size_t blocks = (n + kIdBlock - 1) / kIdBlock;
    file.require_size(file.map(section::kIdBlocks).size() == blocks * sizeof(IdBlock),
                      section::kIdBlocks);
    blocks_ = read_section<IdBlock>(file, section::kIdBlocks, blocks);
    gaps_ = file.map(section::kIdGaps);
    check_blocks();
  }

  bool are_indices() const { return blocks_.empty(); }
  // Throws FileError if the id is not below those of the next block.
  int64_t operator[](LandmarkIndex landmark) const {
    if (are_indices()) return landmark.value;
    const size_t b = landmark.value / kIdBlock, j = landmark.value % kIdBlock;
    const IdBlock& block = blocks_[b];
    const uint64_t id = static_cast<uint64_t>(block.first_id) + j +
                        packed_number(gaps_.data() + 8 * block.first_word(), block.bits(), j);
    file_->require(id < end_of(b), kNoOrder);
    return static_cast<int64_t>(id);
  }
  // Throws UnknownLandmark.
  LandmarkIndex find(int64_t id) const {
    if (are_indices()) {
      if (id < 0 || static_cast<uint64_t>(id) >= n_) throw UnknownLandmark(id);
      return landmark_at(static_cast<size_t>(id));
    }
    const auto next = std::ranges::upper_bound(blocks_, id, {}, &IdBlock::first_id);
    if (next == blocks_.begin()) throw UnknownLandmark(id);
    size_t first = static_cast<size_t>(next - blocks_.begin() - 1) * kIdBlock;
    for (size_t end = std::min(n_, first + kIdBlock); first < end;) {
      const size_t half = first + (end - first) / 2;
      (*this)[landmark_at(half)] < id ? first = half + 1 : end = half;
    }
    if (first == n_ || (*this)[landmark_at(first)] != id) throw UnknownLandmark(id);
    return landmark_at(first);
  }
  // Returns all ids. Throws FileError unless they ascend.
  std::vector<int64_t> all() const {
    std::vector<int64_t> result(n_);
    for (size_t i = 0; i < n_; ++i) {
      result[i] = (*this)[landmark_at(i)];
      file_->require(i == 0 || result[i] > result[i - 1], kNoOrder);
    }
    return result;
  }

 private:
  static constexpr char kNoOrder[] = "its landmark ids do not ascend";

  size_t block_size(size_t b) const { return std::min(kIdBlock, n_ - b * kIdBlock); }
  uint64_t end_of(size_t b) const {
    return b + 1 < blocks_.size() ? static_cast<uint64_t>(blocks_[b + 1].first_id)
                                  : uint64_t{1} << 63;
  }
  // Checks that blocks of gaps follow each other, and that ids can ascend.
  void check_blocks() const {
    size_t words = 0;
    for (size_t b = 0; b < blocks_.size(); ++b) {
      const IdBlock& block = blocks_[b];
      file_->require(block.first_word() == words, "its blocks of ids do not follow each other");
      words += packed_words(block_size(b), block.bits());
      file_->require(block.first_id >= 0, "it has a negative landmark id");
      // The last id of a block is at least this.
      file_->require(static_cast<uint64_t>(block.first_id) + block_size(b) <= end_of(b), kNoOrder);
    }
    file_->require_size(packed_bytes(words, 64) == gaps_.size(), section::kIdGaps);
  }

  const ContainerReader* file_ = nullptr;
  size_t n_ = 0;
  std::vector<IdBlock> blocks_;
  Bytes gaps_;
};

}  // namespace protomark
