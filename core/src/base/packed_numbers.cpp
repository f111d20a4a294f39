#include "base/packed_numbers.h"

#include <algorithm>
#include <utility>

#include "base/checksums.h"
#include "protomark/types.h"

namespace protomark {

CheckedNumbers::CheckedNumbers(std::span<const std::uint64_t> words, int bits,
                               std::span<const std::uint32_t> checksums, std::string name)
    : words_(words),
      bits_(bits),
      checksums_(checksums),
      name_(std::move(name)),
      checked_(std::make_unique<std::atomic<bool>[]>(checksums.size())) {}

void CheckedNumbers::check_now(std::size_t block) const {
  const std::size_t first = block * kBlock;
  const auto words = words_.subspan(first, std::min(kBlock, words_.size() - first));
  if (crc32(std::as_bytes(words)) != checksums_[block]) {
    throw FileError(name_ + " does not match its checksum, in the block at byte " +
                    std::to_string(first * sizeof(words[0])) + " of it");
  }
  // Mapped bytes do not change: any thread that sees this may read them.
  checked_[block].store(true, std::memory_order_relaxed);
}

void BlockChecksums::add(std::span<const std::uint64_t> words) {
  while (!words.empty()) {
    if (filled_ == 0) checksums_.push_back(0);
    const auto part = words.first(std::min(words.size(), CheckedNumbers::kBlock - filled_));
    checksums_.back() = crc32(std::as_bytes(part), checksums_.back());
    filled_ = (filled_ + part.size()) % CheckedNumbers::kBlock;
    words = words.subspan(part.size());
  }
}

}  // namespace protomark
