// Section `order` of a sealed map: the number of the landmark of each place, in few bits.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "file/container.h"

namespace protomark {

// Bytes of the order that have a checksum together, in section `ordersum`.
inline constexpr std::size_t kOrderBlock = 4096;

constexpr std::size_t order_checksums_size(std::size_t order_size) {
  return (order_size + kOrderBlock - 1) / kOrderBlock * sizeof(std::uint32_t);
}

// The checksums of an order, as its bytes come.
class OrderChecksums {
 public:
  void add(Bytes bytes);
  // Of all blocks, the last one included.
  const std::vector<std::uint32_t>& all() const { return checksums_; }

 private:
  std::vector<std::uint32_t> checksums_;
  std::size_t filled_ = 0;  // bytes of the last block
};

// Reads numbers from where they are mapped. A block is checked against its checksum when the first
// number of it is read, so that opening reads none of them and a broken one never answers. Reads
// are safe from any thread.
class OrderNumbers {
 public:
  // Checks the size, and the whole section where an old file has no checksums of blocks. `file`
  // must outlive this. Throws FileError.
  OrderNumbers(const ContainerReader& file, std::size_t places, int bits);

  // Throws FileError where the block is broken.
  std::uint32_t operator[](std::size_t place) const {
    const std::size_t first = place / 8 * bits_ + place % 8 * bits_ / 8;
    check(first / kOrderBlock);
    check((first + kLongest - 1) / kOrderBlock);
    return number(place);
  }

 private:
  // Bytes that the bits of a number are in, at most; there are more of them behind the last.
  static constexpr std::size_t kLongest = 5;

  void check(std::size_t block) const {
    if (checked_ && !checked_[block].load(std::memory_order_relaxed)) check_now(block);
  }
  void check_now(std::size_t block) const;
  std::uint32_t number(std::size_t place) const;

  const ContainerReader* file_;
  Bytes bytes_;
  std::size_t bits_;
  std::span<const std::uint32_t> checksums_;
  std::unique_ptr<std::atomic<bool>[]> checked_;  // nullptr: all are
};

}  // namespace protomark
