#include "file/labels.h"

#include <string>

#include "base/crc32.h"
#include "file/bit_numbers.h"
#include "file/sections.h"

namespace protomark {

void OrderChecksums::add(Bytes bytes) {
  while (!bytes.empty()) {
    if (filled_ == 0) checksums_.push_back(0);
    const Bytes some = bytes.first(std::min(bytes.size(), kOrderBlock - filled_));
    checksums_.back() = crc32(some, checksums_.back());
    filled_ = (filled_ + some.size()) % kOrderBlock;
    bytes = bytes.subspan(some.size());
  }
}

OrderNumbers::OrderNumbers(const ContainerReader& file, std::size_t places, int bits)
    : file_(&file), bits_(static_cast<std::size_t>(bits)) {
  const auto bytes = file.map_if_there(section::kOrder);
  if (!bytes) file.fail("it lacks the section 'order'");
  if (bytes->size() != bit_numbers_size(places, bits)) {
    file.fail("its section 'order' has the wrong size");
  }
  bytes_ = *bytes;
  const auto checksums = file.read_if_there(section::kOrderChecksums);
  if (!checksums) {
    file.read(section::kOrder);
    return;
  }
  if (checksums->size() != order_checksums_size(bytes_.size())) {
    file.fail("its section 'ordersum' has the wrong size");
  }
  const std::size_t blocks = checksums->size() / sizeof(std::uint32_t);
  checksums_ = {reinterpret_cast<const std::uint32_t*>(checksums->data()), blocks};
  checked_ = std::make_unique<std::atomic<bool>[]>(blocks);
}

void OrderNumbers::check_now(std::size_t block) const {
  const std::size_t first = block * kOrderBlock;
  const Bytes bytes = bytes_.subspan(first, std::min(kOrderBlock, bytes_.size() - first));
  if (crc32(bytes) != checksums_[block]) {
    file_->fail("its section 'order' does not match its checksum, in the block at byte " +
                std::to_string(first) + " of it");
  }
  // Bytes that are mapped do not change: whoever sees this may read them.
  checked_[block].store(true, std::memory_order_relaxed);
}

std::uint32_t OrderNumbers::number(std::size_t place) const {
  return bit_number(reinterpret_cast<const std::uint8_t*>(bytes_.data()), static_cast<int>(bits_),
                    place);
}

}  // namespace protomark
