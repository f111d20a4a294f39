// Arrays for random access.
#pragma once

#include <bit>
#include <utility>

#include "base/bytes.h"

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace protomark {

// Begins at a cache line, and in huge pages if it is large, so that few reads walk page tables.
template <typename T>
struct LargePageAllocator {
  using value_type = T;

  LargePageAllocator() = default;
  template <typename U>
  LargePageAllocator(const LargePageAllocator<U>&) {}  // NOLINT: allocators convert

  T* allocate(size_t n) {
    if (n > SIZE_MAX / sizeof(T)) throw std::bad_array_new_length();
    const size_t size = n * sizeof(T);
    void* memory = ::operator new(size, alignment(size));
#ifdef __linux__
    // Memory that was in use before keeps its small pages unless they are dropped.
    if (size >= kLarge) {
      madvise(memory, size, MADV_HUGEPAGE);
      madvise(memory, size / kPage * kPage, MADV_DONTNEED);
    }
#endif
    return static_cast<T*>(memory);
  }
  void deallocate(T* memory, size_t n) { ::operator delete(memory, alignment(n * sizeof(T))); }

  bool operator==(const LargePageAllocator&) const = default;

 private:
  static constexpr size_t kPage = size_t{1} << 21, kLarge = 4 * kPage;
  static constexpr size_t kCacheLine = 64;

  static std::align_val_t alignment(size_t size) {
    return std::align_val_t{size >= kLarge ? kPage : kCacheLine};
  }
};

template <typename T>
using LargeVector = std::vector<T, LargePageAllocator<T>>;

// Arrays of `size` bytes each, at least 4, which stay where they are while others come and go.
class Slots {
 public:
  explicit Slots(size_t size) : size_(size) {}

  const int8_t* operator[](uint32_t slot) const {
    const auto [chunk, at] = place(slot);
    return chunks_[chunk].data() + at * size_;
  }
  int8_t* operator[](uint32_t slot) { return const_cast<int8_t*>(std::as_const(*this)[slot]); }

  // Makes sure that the next `take` does not throw for want of memory.
  void make_room() {
    if (free_ != kNone) return;
    const size_t chunk = place(used_).first;
    if (chunk == chunks_.size()) chunks_.emplace_back();
    chunks_[chunk].reserve((kFirst << chunk) * size_);
  }
  uint32_t take() {
    make_room();
    const uint32_t slot = free_ != kNone ? free_ : used_;
    if (slot == used_) {
      auto& chunk = chunks_[place(used_++).first];
      chunk.resize(chunk.size() + size_);
    } else {
      free_ = load<uint32_t>((*this)[slot]);
    }
    return slot;
  }
  void give_back(uint32_t slot) {
    store((*this)[slot], free_);
    free_ = slot;
  }

 private:
  static constexpr size_t kFirst = 256;
  static constexpr uint32_t kNone = UINT32_MAX;

  // The chunk that a slot is in, each of which has twice as many as the one before, and where.
  static std::pair<size_t, size_t> place(size_t slot) {
    const auto chunk = static_cast<size_t>(std::bit_width(slot / kFirst + 1) - 1);
    return {chunk, slot + kFirst - (kFirst << chunk)};
  }

  size_t size_;
  std::vector<LargeVector<int8_t>> chunks_;
  // The first slot that was given back, which begins with the next one; how many were ever taken.
  uint32_t free_ = kNone, used_ = 0;
};

}  // namespace protomark
