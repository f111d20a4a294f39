// The map files that the journals to be fuzzed belong to.
#pragma once

#include <filesystem>
#include <memory>
#include <vector>

#include "protomark/protomark.h"
#include "random.h"

namespace protomark::fuzz {

// Observations of some landmarks, the same each time.
inline void observe(PrototypeMap& map, std::uint32_t seed, std::int64_t first) {
  test::Random random(seed);
  const std::size_t n = 10, dim = map.dim();
  const auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  const auto ids = random.integers<std::int64_t>(n, first, first + 5);
  map.add_codes(ids, {codes.data(), n, dim});
}

// With one row per landmark, and with several.
inline std::vector<PrototypeMap> journal_bases() {
  test::Random random(11);
  std::vector<Layer> layers = {test::random_layer(random, 64, 4)};
  const auto encoder = std::make_shared<const Encoder>(
      Encoder({"seed", "test", "", "", {}}, std::move(layers), {4}, 0.5f));
  std::vector<PrototypeMap> result;
  for (const std::size_t appearance_bits : {0, 2}) {
    observe(result.emplace_back(encoder, 0, appearance_bits), 1, 0);
  }
  return result;
}

}  // namespace protomark::fuzz
