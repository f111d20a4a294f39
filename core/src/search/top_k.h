// The k nearest that queries have met so far, sorted; ties go to the smaller id.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace protomark {

struct Range {
  std::size_t begin;
  std::size_t end;
  std::size_t size() const { return end - begin; }
};

// The places of one query, in the caller's arrays. Empty places have id -1, which counts as larger
// than all others, and the limit as their distance.
class TopK {
 public:
  TopK(std::int64_t* ids, std::int32_t* distances, std::size_t k)
      : ids_(ids), distances_(distances), k_(k) {}

  // The distance that a candidate must not exceed.
  std::int32_t limit() const { return distances_[k_ - 1]; }

  // Takes a candidate whose id has not been offered before. One or two places, which most searches
  // ask for, need no loop.
  void offer(std::int32_t distance, std::int64_t id) {
    if (k_ > 2) {
      if (before(distance, id, k_ - 1)) insert(distance, id, k_ - 1);
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
      insert(distance, id, k_ - 1);
    } else if (distance < distances_[at]) {
      insert(distance, id, at);
    }
  }

 private:
  bool before(std::int32_t distance, std::int64_t id, std::size_t i) const {
    return distance < distances_[i] ||
           (distance == distances_[i] &&
            static_cast<std::uint64_t>(id) < static_cast<std::uint64_t>(ids_[i]));
  }

  // Overwrites place i and moves the newcomer up to where it belongs.
  void insert(std::int32_t distance, std::int64_t id, std::size_t i) {
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
};

// The places of some queries.
class Neighbours {
 public:
  // Distances above its limit never enter a query's places.
  Neighbours(std::size_t k, std::span<const std::int32_t> limits)
      : k_(k), ids_(limits.size() * k, -1) {
    distances_.reserve(ids_.size());
    for (const std::int32_t limit : limits) distances_.insert(distances_.end(), k, limit);
  }

  std::size_t queries() const { return ids_.size() / k_; }
  std::size_t k() const { return k_; }
  std::int32_t limit(std::size_t query) const { return distances_[query * k_ + k_ - 1]; }
  TopK operator[](std::size_t query) {
    return {ids_.data() + query * k_, distances_.data() + query * k_, k_};
  }
  const std::int64_t* ids(std::size_t query) const { return ids_.data() + query * k_; }
  const std::int32_t* distances(std::size_t query) const { return distances_.data() + query * k_; }

  Neighbours part(Range queries) const {
    Neighbours result(k_, {});
    result.ids_.assign(ids(queries.begin), ids(queries.end));
    result.distances_.assign(distances(queries.begin), distances(queries.end));
    return result;
  }
  // Takes what `part`, of the queries from `first` on, has found.
  void merge(std::size_t first, const Neighbours& part) {
    for (std::size_t i = 0; i < part.ids_.size(); ++i) {
      if (part.ids_[i] < 0) continue;
      (*this)[first + i / k_].offer_distinct(part.distances_[i], part.ids_[i]);
    }
  }

 private:
  std::size_t k_;
  std::vector<std::int64_t> ids_;
  std::vector<std::int32_t> distances_;
};

}  // namespace protomark
