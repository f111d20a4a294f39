// The fuzzer's input as a mapped file would be: at a multiple of 64 bytes, and not a byte longer.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <span>

namespace protomark::fuzz {

class AlignedCopy {
 public:
  AlignedCopy(const std::uint8_t* data, std::size_t size)
      : data_(static_cast<std::byte*>(::operator new(size, kAlignment))), size_(size) {
    if (size > 0) std::memcpy(data_.get(), data, size);
  }
  std::span<const std::byte> bytes() const { return {data_.get(), size_}; }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Delete {
    void operator()(std::byte* p) const { ::operator delete(p, kAlignment); }
  };
  std::unique_ptr<std::byte, Delete> data_;
  std::size_t size_;
};

}  // namespace protomark::fuzz
