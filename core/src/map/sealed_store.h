// How a map is sealed: bits per number of a prototype, and how many prototypes.
#pragma once

#include <cstddef>
#include <optional>

#include "map/prototype_store.h"

namespace protomark {

struct SealFormat {
  int bits;               // per number of a prototype, 8 or 4
  std::size_t row_limit;  // prototypes in all
};

// Chooses the format for a number of bytes per landmark, as SealOptions says. Throws
// std::invalid_argument, with the smallest possible number, if that is too small.
SealFormat seal_format(const PrototypeStore& store, std::optional<double> bytes_per_landmark);

// Bytes that the prototypes, their number and the counts of so many landmarks take.
std::size_t sealed_bytes(std::size_t landmarks, std::size_t rows, std::size_t dim, int bits);

// Bits that the owner of a row takes in a map of so many landmarks; padding has that number.
int owner_bits(std::size_t landmarks);

// Merges appearances until there are at most `limit` rows, and 255 of any landmark. Returns a store
// of the prototypes, in lists of the same centroids, or nullopt if nothing has to be merged. Of
// more than 255 observations it has the rounded prototype, with a count of one.
std::optional<PrototypeStore> merge_appearances(const PrototypeStore& store, std::size_t limit);

}  // namespace protomark
