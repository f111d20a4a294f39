// How tests ask for sealed maps of 4 bits per number.
#pragma once

#include <optional>

#include "protomark/protomark.h"

namespace protomark::test {

// Options that seal a map with 4 bits per number and so many prototypes per landmark; by default
// with all that it has.
inline SealOptions four_bits(const PrototypeMap& map, std::optional<double> prototypes = {}) {
  const double all = map.size() == 0 ? 1.0
                                     : static_cast<double>(map.prototype_count()) /
                                           static_cast<double>(map.size());
  const double wanted = prototypes.value_or(all);
  const auto bytes = static_cast<double>((map.dim() + 7) / 8 * 4);
  return {.bytes_per_landmark = wanted * bytes + (wanted > 1 && all > 1 ? 2 : 1)};
}

}  // namespace protomark::test
