// A vector for random access: it begins at a cache line, and a large one lies in huge pages, which
// spares most reads a page-table walk.
#pragma once

#include <cstddef>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace protomark {

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

}  // namespace protomark
