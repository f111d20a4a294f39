// Numbers of 0 to 63 bits, packed one after the other in 64-bit words, least significant bits
// first.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace protomark {

constexpr std::size_t packed_words(std::size_t n, int bits) {
  return (n * static_cast<std::size_t>(bits) + 63) / 64;
}

inline std::uint64_t packed_number(const std::uint64_t* words, int bits, std::size_t i) {
  if (bits == 0) return 0;
  const auto width = static_cast<std::size_t>(bits);
  const std::size_t first = i * width, shift = first % 64;
  std::uint64_t value = words[first / 64] >> shift;
  if (shift + width > 64) value |= words[first / 64 + 1] << (64 - shift);
  return value & ((std::uint64_t{1} << width) - 1);
}

class BitPacker {
 public:
  void add(std::uint64_t value, int bits) {
    const auto width = static_cast<unsigned>(bits);
    word_ |= value << filled_;
    filled_ += width;
    if (filled_ < 64) return;
    words_.push_back(word_);
    filled_ -= 64;
    word_ = filled_ == 0 ? 0 : value >> (width - filled_);
  }
  // Fills the last word up with zeros.
  void align() {
    if (filled_ > 0) words_.push_back(word_);
    word_ = 0;
    filled_ = 0;
  }
  // The words that are full; the caller may clear them.
  std::vector<std::uint64_t>& words() { return words_; }

 private:
  std::vector<std::uint64_t> words_;
  std::uint64_t word_ = 0;
  unsigned filled_ = 0;  // bits of word_
};

}  // namespace protomark
