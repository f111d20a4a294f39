// What a test allocates, counted; and allocations that fail. For one file of a program.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdlib>
#include <new>

#include <malloc.h>

namespace protomark::test {

inline std::atomic<std::size_t> held{0}, most{0};
// Allocations until one fails; negative: none does.
inline std::atomic<long> left{-1};

inline void* counted(std::size_t size, std::size_t alignment) {
  if (left >= 0 && left-- == 0) throw std::bad_alloc();
  void* memory = std::aligned_alloc(alignment, (size + alignment - 1) / alignment * alignment);
  if (memory == nullptr) throw std::bad_alloc();
  const std::size_t now = held += malloc_usable_size(memory);
  for (std::size_t before = most; before < now && !most.compare_exchange_weak(before, now);) {
  }
  return memory;
}

inline void release(void* memory) {
  if (memory != nullptr) held -= malloc_usable_size(memory);
  std::free(memory);
}

// Bytes that it takes at most while it works.
template <typename Work>
std::size_t memory_of(const Work& work) {
  const std::size_t before = held;
  most = before;
  work();
  return most - before;
}

}  // namespace protomark::test

// Inlined, they look mismatched to g++.
[[gnu::noinline]] void* operator new(std::size_t size) {
  return protomark::test::counted(size, alignof(std::max_align_t));
}
[[gnu::noinline]] void* operator new(std::size_t size, std::align_val_t alignment) {
  return protomark::test::counted(size, static_cast<std::size_t>(alignment));
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { protomark::test::release(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept {
  protomark::test::release(memory);
}
[[gnu::noinline]] void operator delete(void* memory, std::align_val_t) noexcept {
  protomark::test::release(memory);
}
[[gnu::noinline]] void operator delete(void* memory, std::size_t, std::align_val_t) noexcept {
  protomark::test::release(memory);
}
