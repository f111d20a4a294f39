// What changed in a map since its last commit.
#pragma once

#include <cstdint>
#include <new>

#include "base/id_set.h"

namespace protomark {

class Changes {
 public:
  bool empty() const { return !cells && !metadata && ids_.empty() && !incomplete_; }
  // Of landmarks that came, changed or went, each once, in no order.
  const LargeVector<std::int64_t>& ids() const { return ids_.ids(); }
  // Memory ran out, and some ids are missing.
  bool incomplete() const { return incomplete_; }

  // Never throws, so that a change that was made is never half noted.
  void insert(std::int64_t id) noexcept {
    try {
      ids_.insert(id);
    } catch (const std::bad_alloc&) {
      incomplete_ = true;
    }
  }
  void insert(const Changes& other) noexcept {
    for (const std::int64_t id : other.ids()) insert(id);
    cells = cells || other.cells;
    metadata = metadata || other.metadata;
    incomplete_ = incomplete_ || other.incomplete_;
  }

  bool cells = false;  // the centroids
  bool metadata = false;

 private:
  IdSet ids_;
  bool incomplete_ = false;
};

}  // namespace protomark
