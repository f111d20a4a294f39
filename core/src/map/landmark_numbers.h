// Which landmark of an open map is which of a sealed one.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "map/prototype_store.h"

namespace protomark {

// Numbers of landmarks by id, 0 for the smallest, in little more than a byte each: the id says
// which block of 256 a landmark is in.
class LandmarkNumbers {
 public:
  explicit LandmarkNumbers(const PrototypeStore& store)
      : store_(&store), place_(store.ids().size()) {}

  // Landmarks come by ascending id.
  void add(std::uint32_t landmark) {
    if (added_ % kBlock == 0) first_ids_.push_back(store_->ids()[landmark]);
    place_[landmark] = static_cast<std::uint8_t>(added_++ % kBlock);
  }

  std::uint32_t operator[](std::uint32_t landmark) const {
    const std::int64_t id = store_->ids()[landmark];
    const auto next = std::upper_bound(first_ids_.begin(), first_ids_.end(), id);
    const auto block = static_cast<std::size_t>(next - first_ids_.begin()) - 1;
    return static_cast<std::uint32_t>(block * kBlock + place_[landmark]);
  }

 private:
  static constexpr std::size_t kBlock = 256;

  const PrototypeStore* store_;
  std::vector<std::uint8_t> place_;  // of a landmark in its block
  std::vector<std::int64_t> first_ids_;
  std::size_t added_ = 0;
};

}  // namespace protomark
