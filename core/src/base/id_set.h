// A set of landmark ids.
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/id_index.h"
#include "base/large_vector.h"

namespace protomark {

class IdSet {
 public:
  bool empty() const { return ids_.empty(); }
  bool contains(std::int64_t id) const { return index_.find(ids_, id) != IdIndex::kNone; }
  // Each once, as they came.
  const LargeVector<std::int64_t>& ids() const { return ids_; }

  // Where memory runs out the set is as before.
  void insert(std::int64_t id) {
    if (contains(id)) return;
    ids_.push_back(id);
    try {
      index_.insert(ids_, static_cast<std::uint32_t>(ids_.size() - 1));
    } catch (...) {
      ids_.pop_back();
      throw;
    }
  }

 private:
  LargeVector<std::int64_t> ids_;
  IdIndex index_;
};

}  // namespace protomark
