// How tests ask for sealed maps whose prototypes are words.
#pragma once

#include <algorithm>
#include <optional>

#include "protomark/protomark.h"

namespace protomark::test {

// Returns the number of words that most codebooks of the map's encoder would give its prototypes,
// without fewer numbers.
inline std::size_t most_words(const PrototypeMap& map) {
  std::size_t words = 0;
  for (const Codebook& codebook : map.encoder()->codebooks()) {
    if (codebook.covers(map.dim())) words = std::max(words, map.dim() / codebook.width);
  }
  return words;
}

// Options that seal a map with that many words and so many prototypes per landmark; by default with
// all that it has.
inline SealOptions in_words(const PrototypeMap& map, std::optional<double> prototypes = {}) {
  const double all = map.size() == 0 ? 1.0
                                     : static_cast<double>(map.prototype_count()) /
                                           static_cast<double>(map.size());
  const double wanted = prototypes.value_or(all);
  return {.bytes_per_landmark =
              wanted * static_cast<double>(most_words(map)) + (wanted > 1 && all > 1 ? 1 : 0)};
}

}  // namespace protomark::test
