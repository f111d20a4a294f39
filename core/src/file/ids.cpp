#include "file/ids.h"

#include <algorithm>
#include <bit>

#include "file/sections.h"
#include "protomark/error.h"

namespace protomark {
namespace {

constexpr std::uint64_t kWordBits = 64;

int bits_of(const IdBlock& block) { return static_cast<int>(block.place % kWordBits); }
std::size_t first_word(const IdBlock& block) { return block.place / kWordBits; }

std::size_t words_for(std::size_t landmarks, int bits) {
  return (landmarks * static_cast<std::size_t>(bits) + kWordBits - 1) / kWordBits;
}

std::uint64_t rest(const std::uint64_t* words, int bits, std::size_t j) {
  if (bits == 0) return 0;
  const std::size_t first = j * static_cast<std::size_t>(bits), shift = first % kWordBits;
  std::uint64_t value = words[first / kWordBits] >> shift;
  if (shift + static_cast<std::size_t>(bits) > kWordBits) {
    value |= words[first / kWordBits + 1] << (kWordBits - shift);
  }
  return value & ((std::uint64_t{1} << bits) - 1);
}

void set_rest(std::uint64_t* words, int bits, std::size_t j, std::uint64_t value) {
  if (bits == 0) return;
  const std::size_t first = j * static_cast<std::size_t>(bits), shift = first % kWordBits;
  words[first / kWordBits] |= value << shift;
  if (shift + static_cast<std::size_t>(bits) > kWordBits) {
    words[first / kWordBits + 1] |= value >> (kWordBits - shift);
  }
}

// Sections stand at multiples of 64 bytes, so values are aligned.
template <typename T>
std::span<const T> values(const ContainerReader& file, const char* name, Bytes bytes) {
  if (bytes.size() % sizeof(T) != 0) {
    file.fail("its section '" + std::string(name) + "' has the wrong size");
  }
  return {reinterpret_cast<const T*>(bytes.data()), bytes.size() / sizeof(T)};
}

}  // namespace

bool ids_are_numbers(std::size_t n, std::int64_t last) {
  return n == 0 || last == static_cast<std::int64_t>(n) - 1;
}

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
  const std::int64_t base = ids_.front();
  const auto most = static_cast<std::uint64_t>(ids_.back() - base) - (ids_.size() - 1);
  const auto bits = static_cast<int>(std::bit_width(most));
  const std::size_t at = rests_.size(), words = words_for(ids_.size(), bits);
  blocks_.push_back({base, words_ * kWordBits + static_cast<std::uint64_t>(bits)});
  rests_.resize(at + words, 0);
  for (std::size_t j = 0; j < ids_.size(); ++j) {
    set_rest(rests_.data() + at, bits, j, static_cast<std::uint64_t>(ids_[j] - base) - j);
  }
  words_ += words;
  ids_.clear();
  if (blocks_.size() == kPiece) flush();
}

void IdBlockWriter::flush() {
  to_blocks_(std::as_bytes(std::span(blocks_)));
  to_rests_(std::as_bytes(std::span(rests_)));
  blocks_.clear();
  rests_.clear();
}

LandmarkIds::LandmarkIds(const ContainerReader& file, std::size_t n) : file_(&file), n_(n) {
  if (const auto bytes = file.read_if_there(section::kIds)) {
    plain_ = values<std::int64_t>(file, section::kIds, *bytes);
    if (plain_.size() != n) file.fail("its section 'ids' has the wrong size");
    check_ids(file, plain_);
  } else if (const auto blocks = file.read_if_there(section::kIdBlocks)) {
    blocks_ = values<IdBlock>(file, section::kIdBlocks, *blocks);
    const auto rests = file.map_if_there(section::kIdRests);
    if (!rests) file.fail("it lacks the section 'idrests'");
    words_ = values<std::uint64_t>(file, section::kIdRests, *rests);
    check_blocks();
  }
}

// That rests are where they should be, and that ids can ascend.
void LandmarkIds::check_blocks() const {
  if (blocks_.size() != (n_ + kIdBlock - 1) / kIdBlock) {
    file_->fail("its section 'idblocks' has the wrong size");
  }
  std::size_t words = 0;
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (first_word(blocks_[b]) != words) file_->fail("its blocks of ids do not follow each other");
    words += words_for(block_size(b), bits_of(blocks_[b]));
    if (blocks_[b].base < 0) file_->fail("it has a negative landmark id");
    // The last id of a block is at least this.
    if (static_cast<std::uint64_t>(blocks_[b].base) + block_size(b) > end_of(b)) {
      file_->fail("its landmark ids do not ascend");
    }
  }
  if (words != words_.size()) file_->fail("its section 'idrests' has the wrong size");
}

std::size_t LandmarkIds::block_size(std::size_t b) const {
  return std::min(kIdBlock, n_ - b * kIdBlock);
}

// Ids of a block are below.
std::uint64_t LandmarkIds::end_of(std::size_t b) const {
  return b + 1 < blocks_.size() ? static_cast<std::uint64_t>(blocks_[b + 1].base)
                                : std::uint64_t{1} << 63;
}

std::int64_t LandmarkIds::operator[](std::size_t number) const {
  if (are_numbers()) return static_cast<std::int64_t>(number);
  if (!plain_.empty()) return plain_[number];
  const std::size_t b = number / kIdBlock, j = number % kIdBlock;
  const IdBlock& block = blocks_[b];
  const std::uint64_t id = static_cast<std::uint64_t>(block.base) + j +
                           rest(words_.data() + first_word(block), bits_of(block), j);
  if (id >= end_of(b)) file_->fail("its landmark ids do not ascend");
  return static_cast<std::int64_t>(id);
}

std::size_t LandmarkIds::find(std::int64_t id) const {
  std::size_t first = 0, end = n_;
  if (are_numbers()) {
    first =
        static_cast<std::size_t>(std::clamp<std::int64_t>(id, 0, static_cast<std::int64_t>(n_)));
    end = first;
  } else if (!blocks_.empty()) {
    const auto next =
        std::upper_bound(blocks_.begin(), blocks_.end(), id,
                         [](std::int64_t wanted, const IdBlock& b) { return wanted < b.base; });
    if (next == blocks_.begin()) throw UnknownLandmark(id);
    first = static_cast<std::size_t>(next - blocks_.begin() - 1) * kIdBlock;
    end = std::min(n_, first + kIdBlock);
  }
  while (first < end) {
    const std::size_t half = first + (end - first) / 2;
    if ((*this)[half] < id) {
      first = half + 1;
    } else {
      end = half;
    }
  }
  if (first >= n_ || (*this)[first] != id) throw UnknownLandmark(id);
  return first;
}

std::vector<std::int64_t> LandmarkIds::all() const {
  std::vector<std::int64_t> result(n_);
  for (std::size_t i = 0; i < n_; ++i) {
    result[i] = (*this)[i];
    if (i > 0 && result[i] <= result[i - 1]) file_->fail("its landmark ids do not ascend");
  }
  return result;
}

}  // namespace protomark
