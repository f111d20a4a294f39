// Packed numbers in a mapped file that are checked against checksums as they are read.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "base/bits.h"

namespace protomark {

// Opening a map reads none of these numbers. A block of them is checked when the first number of it
// is read, so that a broken block never answers. Any number of threads may read.
class CheckedNumbers {
 public:
  static constexpr std::size_t kBlock = 512;  // words that have a CRC-32 together

  static constexpr std::size_t blocks(std::size_t words) { return (words + kBlock - 1) / kBlock; }

  // `checksums` are those of the blocks. Errors begin with `name`.
  CheckedNumbers(std::span<const std::uint64_t> words, int bits,
                 std::span<const std::uint32_t> checksums, std::string name);

  // Throws FileError if the number's block is broken.
  std::uint64_t operator[](std::size_t i) const {
    const std::size_t first = i * static_cast<std::size_t>(bits_);
    check(first / 64 / kBlock);
    check((first + static_cast<std::size_t>(bits_) - 1) / 64 / kBlock);
    return packed_number(words_.data(), bits_, i);
  }

 private:
  void check(std::size_t block) const {
    if (!checked_[block].load(std::memory_order_relaxed)) check_now(block);
  }
  void check_now(std::size_t block) const;

  std::span<const std::uint64_t> words_;
  int bits_;
  std::span<const std::uint32_t> checksums_;
  std::string name_;
  std::unique_ptr<std::atomic<bool>[]> checked_;
};

// The checksums of blocks, while their words come.
class BlockChecksums {
 public:
  void add(std::span<const std::uint64_t> words);
  const std::vector<std::uint32_t>& all() const { return checksums_; }

 private:
  std::vector<std::uint32_t> checksums_;
  std::size_t filled_ = 0;  // words of the last block
};

}  // namespace protomark
