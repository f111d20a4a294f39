// An open map as it is in its file and the journal beside it.
#pragma once

#include <cstdint>
#include <vector>

#include "file/container.h"
#include "file/journal.h"
#include "map/prototype_store.h"

namespace protomark {

struct OpenMapContent {
  Metadata metadata;
  std::vector<std::int8_t> cells;  // centroids of the index; none: there is none
};

// Reads a map file and the commits to it into a store that is empty and has its dimension and look
// bits. Time is proportional to what is read, whatever that is. Throws FileError.
OpenMapContent read_open_map(const ContainerReader& file, const JournalContent& journal,
                             const Encoder& encoder, PrototypeStore& store);

}  // namespace protomark
