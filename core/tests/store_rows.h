// Rows of a store for tests.
#pragma once

#include "map/prototype_store.h"

namespace protomark::test {

// Returns the row of a landmark's appearance, if need be a new one with a sum and count of zero.
inline Row find_or_create_row(PrototypeStore& store, int64_t id, uint16_t appearance) {
  LandmarkIndex landmark = store.find(id);
  const Row row = landmark == kNoLandmark ? kNoRow : store.find_row(landmark, appearance);
  return row != kNoRow ? row : store.create_row(id, landmark, appearance);
}

}  // namespace protomark::test
