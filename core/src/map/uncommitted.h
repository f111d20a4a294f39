// What changed in a learning map since its last commit.
#pragma once

#include <cstdint>
#include <new>

#include "base/id_index.h"

namespace protomark {

class Uncommitted {
 public:
  bool empty() const { return !centroids && !metadata && ids_.empty() && !incomplete_; }
  // Landmarks that came, changed or went, each once, in no order.
  const LargeVector<std::int64_t>& ids() const { return ids_.ids(); }
  // Whether memory ran out, so that some ids are missing.
  bool incomplete() const { return incomplete_; }

  // Never throws, so that no change is made and not noted.
  void insert(std::int64_t id) noexcept {
    try {
      ids_.insert(id);
    } catch (const std::bad_alloc&) {
      incomplete_ = true;
    }
  }
  void insert(const Uncommitted& other) noexcept {
    for (const std::int64_t id : other.ids()) insert(id);
    centroids = centroids || other.centroids;
    metadata = metadata || other.metadata;
    incomplete_ = incomplete_ || other.incomplete_;
  }

  bool centroids = false;
  bool metadata = false;

 private:
  IdSet ids_;
  bool incomplete_ = false;
};

}  // namespace protomark
