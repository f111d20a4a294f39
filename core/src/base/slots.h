// Arrays of bytes of one size, which stay where they are while others come and go.
#pragma once

#include <bit>
#include <cstdint>
#include <cstring>
#include <utility>

#include "base/large_vector.h"

namespace protomark {

class Slots {
 public:
  // `size` is at least 4.
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
      std::memcpy(&free_, (*this)[slot], sizeof(free_));
    }
    return slot;
  }
  void give_back(uint32_t slot) {
    std::memcpy((*this)[slot], &free_, sizeof(free_));
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
  // The first of the slots that were given back, each of which begins with the next one; and how
  // many were ever taken.
  uint32_t free_ = kNone, used_ = 0;
};

}  // namespace protomark
