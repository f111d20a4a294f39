// Numbers of 0 to 63 bits, packed into 64-bit words, least significant bits first.
#pragma once

#include <algorithm>
#include <atomic>
#include <functional>
#include <memory>
#include <utility>

#include "base/bytes.h"
#include "base/text.h"

namespace protomark {

constexpr size_t packed_words(size_t n, int bits) {
  return (n * static_cast<size_t>(bits) + 63) / 64;
}
constexpr size_t packed_bytes(size_t n, int bits) {
  return packed_words(n, bits) * sizeof(uint64_t);
}

// Returns number i. The words may begin anywhere in memory.
inline uint64_t packed_number(const void* words, int bits, size_t i) {
  if (bits == 0) return 0;
  const auto width = static_cast<size_t>(bits), first = i * width, shift = first % 64;
  const char* from = static_cast<const char*>(words) + first / 64 * 8;
  uint64_t value = load<uint64_t>(from) >> shift;
  if (shift + width > 64) value |= load<uint64_t>(from + 8) << (64 - shift);
  return value & ((uint64_t{1} << width) - 1);
}

// Takes the bytes of a section in order.
using Sink = std::function<void(Bytes)>;

// Hands values and packed numbers to a sink in pieces of kPiece bytes or little more.
class ValueWriter {
 public:
  static constexpr size_t kPiece = 1 << 15;

  explicit ValueWriter(Sink sink = {}) : sink_(std::move(sink)) {}

  void add(const auto& value) { store(add_bytes(sizeof(value)), value); }
  // Returns room for n more bytes, to be written before the next call.
  std::byte* add_bytes(size_t n) {
    if (bytes_.size() >= kPiece) flush();
    bytes_.resize(bytes_.size() + n);
    return &bytes_[bytes_.size() - n];
  }
  void add_all(Bytes bytes) {
    flush();
    sink_(bytes);
  }
  // Adds a packed number; one of 64 bits begins at a whole word.
  void add(uint64_t value, int bits) {
    const auto width = static_cast<unsigned>(bits);
    word_ |= value << filled_;
    filled_ += width;
    if (filled_ < 64) return;
    filled_ -= 64;
    add(std::exchange(word_, 0));
    if (filled_ > 0) word_ = value >> (width - filled_);
  }
  void align() {
    if (filled_ > 0) add(std::exchange(word_, 0));
    filled_ = 0;
  }
  void finish() {
    align();
    flush();
  }

 private:
  void flush() {
    if (!bytes_.empty()) sink_(bytes_);
    bytes_.clear();
  }

  Sink sink_;
  std::vector<std::byte> bytes_;
  uint64_t word_ = 0;
  unsigned filled_ = 0;  // bits of word_
};

// Packed numbers in a mapped file. A block of them is checked against its checksum when the first
// number of it is read (or FileError thrown), so that opening reads none and a broken block never
// answers. Any number of threads may read.
class CheckedNumbers {
 public:
  static constexpr size_t kBlock = 512;  // words per CRC-32

  static constexpr size_t blocks(size_t words) { return (words + kBlock - 1) / kBlock; }

  // `checksums` has one per block. Errors begin with `name`.
  CheckedNumbers(std::span<const uint64_t> words, int bits, std::span<const uint32_t> checksums,
                 std::string name)
      : words_(words),
        bits_(bits),
        checksums_(checksums),
        name_(std::move(name)),
        checked_(std::make_unique<std::atomic<bool>[]>(checksums.size())) {}

  uint64_t operator[](size_t i) const {
    const size_t first = i * static_cast<size_t>(bits_);
    check(first / 64 / kBlock);
    check((first + static_cast<size_t>(bits_) - 1) / 64 / kBlock);
    return packed_number(words_.data(), bits_, i);
  }

 private:
  void check(size_t block) const {
    if (!checked_[block].load(std::memory_order_relaxed)) check_now(block);
  }
  void check_now(size_t block) const {
    const size_t first = block * kBlock;
    const auto words = words_.subspan(first, std::min(kBlock, words_.size() - first));
    if (crc32(std::as_bytes(words)) != checksums_[block]) {
      throw FileError(text(name_, " does not match its checksum, in the block at byte ",
                           first * sizeof(words[0]), " of it"));
    }
    checked_[block].store(true, std::memory_order_relaxed);
  }

  std::span<const uint64_t> words_;
  int bits_;
  std::span<const uint32_t> checksums_;
  std::string name_;
  std::unique_ptr<std::atomic<bool>[]> checked_;
};

}  // namespace protomark
