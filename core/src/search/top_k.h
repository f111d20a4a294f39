// The k nearest seen so far, kept sorted in the caller's arrays; ties go to the smaller id.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace protomark {

class TopK {
 public:
  // Distances above `limit` never enter; empty places hold id -1 and distance limit + 1.
  TopK(std::int64_t* ids, std::int32_t* distances, std::size_t k, std::int32_t limit)
      : ids_(ids), distances_(distances), k_(k), limit_(limit) {
    std::fill_n(ids_, k_, std::int64_t{-1});
    std::fill_n(distances_, k_, limit + 1);
  }

  // What a candidate must not exceed to have a chance.
  std::int32_t limit() const { return std::min(limit_, distances_[k_ - 1]); }

  // Takes a candidate whose id has not been offered before. One or two places, which most searches
  // ask for, need no loop.
  void offer(std::int32_t distance, std::int64_t id) {
    if (k_ > 2) {
      if (before(distance, id, k_ - 1)) place(distance, id, k_ - 1);
    } else if (before(distance, id, 0)) {
      if (k_ == 2) set(1, distances_[0], ids_[0]);
      set(0, distance, id);
    } else if (k_ == 2 && before(distance, id, 1)) {
      set(1, distance, id);
    }
  }

  // Takes a candidate whose id may be there already, at another distance.
  void offer_distinct(std::int32_t distance, std::int64_t id) {
    if (!before(distance, id, k_ - 1)) return;
    const auto at = static_cast<std::size_t>(std::find(ids_, ids_ + k_, id) - ids_);
    if (at == k_) {
      place(distance, id, k_ - 1);
    } else if (distance < distances_[at]) {
      place(distance, id, at);
    }
  }

 private:
  bool before(std::int32_t distance, std::int64_t id, std::size_t i) const {
    return distance < distances_[i] || (distance == distances_[i] && id < ids_[i]);
  }

  // Overwrites place i and moves the newcomer up to where it belongs.
  void place(std::int32_t distance, std::int64_t id, std::size_t i) {
    for (; i > 0 && before(distance, id, i - 1); --i) set(i, distances_[i - 1], ids_[i - 1]);
    set(i, distance, id);
  }

  void set(std::size_t i, std::int32_t distance, std::int64_t id) {
    distances_[i] = distance;
    ids_[i] = id;
  }

  std::int64_t* ids_;
  std::int32_t* distances_;
  std::size_t k_;
  std::int32_t limit_;
};

}  // namespace protomark
