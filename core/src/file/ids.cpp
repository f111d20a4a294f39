#include "file/ids.h"

#include <algorithm>
#include <bit>

#include "file/sections.h"

namespace protomark {
namespace {

constexpr char kNoOrder[] = "its landmark ids do not ascend";

int bits_of(const IdBlock& block) { return static_cast<int>(block.gaps % 64); }
std::size_t first_word(const IdBlock& block) { return block.gaps / 64; }

}  // namespace

void IdBlockWriter::add(std::int64_t id) {
  ids_.push_back(id);
  if (ids_.size() == kIdBlock) end_block();
}

void IdBlockWriter::finish() {
  if (!ids_.empty()) end_block();
  flush();
}

void IdBlockWriter::end_block() {
  constexpr std::size_t kPiece = 256;  // blocks
  const auto gap = [&](std::size_t j) {
    return static_cast<std::uint64_t>(ids_[j] - ids_.front()) - j;
  };
  const auto bits = static_cast<int>(std::bit_width(gap(ids_.size() - 1)));
  blocks_.push_back({ids_.front(), words_ * 64 + static_cast<std::uint64_t>(bits)});
  for (std::size_t j = 0; j < ids_.size(); ++j) gaps_.add(gap(j), bits);
  gaps_.align();
  words_ += packed_words(ids_.size(), bits);
  ids_.clear();
  if (blocks_.size() == kPiece) flush();
}

void IdBlockWriter::flush() {
  block_sink_(std::as_bytes(std::span(blocks_)));
  gap_sink_(std::as_bytes(std::span(gaps_.words())));
  blocks_.clear();
  gaps_.words().clear();
}

LandmarkIds::LandmarkIds(const ContainerReader& file, std::size_t n) : file_(&file), n_(n) {
  if (!file.has(section::kIdBlocks)) return;
  blocks_ = file.read<IdBlock>(section::kIdBlocks, (n + kIdBlock - 1) / kIdBlock);
  const std::size_t bytes = file.map(section::kIdGaps).size();
  words_ = file.map<std::uint64_t>(section::kIdGaps, bytes / sizeof(std::uint64_t));
  check_blocks();
}

// Checks that blocks of gaps follow each other, and that ids can ascend.
void LandmarkIds::check_blocks() const {
  std::size_t words = 0;
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (first_word(blocks_[b]) != words) file_->fail("its blocks of ids do not follow each other");
    words += packed_words(block_size(b), bits_of(blocks_[b]));
    if (blocks_[b].first_id < 0) file_->fail("it has a negative landmark id");
    // The last id of a block is at least this.
    if (static_cast<std::uint64_t>(blocks_[b].first_id) + block_size(b) > end_of(b)) {
      file_->fail(kNoOrder);
    }
  }
  if (words != words_.size()) file_->fail_size(section::kIdGaps);
}

std::size_t LandmarkIds::block_size(std::size_t b) const {
  return std::min(kIdBlock, n_ - b * kIdBlock);
}

// Returns a number that all ids of a block are below.
std::uint64_t LandmarkIds::end_of(std::size_t b) const {
  return b + 1 < blocks_.size() ? static_cast<std::uint64_t>(blocks_[b + 1].first_id)
                                : std::uint64_t{1} << 63;
}

std::int64_t LandmarkIds::operator[](LandmarkIndex landmark) const {
  if (are_indices()) return landmark.value;
  const std::size_t b = landmark.value / kIdBlock, j = landmark.value % kIdBlock;
  const IdBlock& block = blocks_[b];
  const std::uint64_t id = static_cast<std::uint64_t>(block.first_id) + j +
                           packed_number(words_.data() + first_word(block), bits_of(block), j);
  if (id >= end_of(b)) file_->fail(kNoOrder);
  return static_cast<std::int64_t>(id);
}

LandmarkIndex LandmarkIds::find(std::int64_t id) const {
  if (are_indices()) {
    if (id < 0 || static_cast<std::uint64_t>(id) >= n_) throw UnknownLandmark(id);
    return landmark_at(static_cast<std::size_t>(id));
  }
  const auto next = std::ranges::upper_bound(blocks_, id, {}, &IdBlock::first_id);
  if (next == blocks_.begin()) throw UnknownLandmark(id);
  std::size_t first = static_cast<std::size_t>(next - blocks_.begin() - 1) * kIdBlock;
  for (std::size_t end = std::min(n_, first + kIdBlock); first < end;) {
    const std::size_t half = first + (end - first) / 2;
    (*this)[landmark_at(half)] < id ? first = half + 1 : end = half;
  }
  if (first == n_ || (*this)[landmark_at(first)] != id) throw UnknownLandmark(id);
  return landmark_at(first);
}

std::vector<std::int64_t> LandmarkIds::all() const {
  std::vector<std::int64_t> result(n_);
  for (std::size_t i = 0; i < n_; ++i) {
    result[i] = (*this)[landmark_at(i)];
    if (i > 0 && result[i] <= result[i - 1]) file_->fail(kNoOrder);
  }
  return result;
}

}  // namespace protomark
