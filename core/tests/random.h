// Random input of the same values on every machine.
#pragma once

#include <cstdint>
#include <memory>
#include <random>
#include <vector>

#include "protomark/protomark.h"

namespace protomark::test {

// std::uniform_int_distribution differs between standard libraries; this does not.
class Random {
 public:
  explicit Random(std::uint32_t seed) : engine_(seed) {}
  std::int64_t integer(std::int64_t low, std::int64_t high) {
    const auto range = static_cast<std::uint64_t>(high) - static_cast<std::uint64_t>(low) + 1;
    return low + static_cast<std::int64_t>(engine_() % range);
  }
  template <typename T>
  std::vector<T> integers(std::size_t n, std::int64_t low, std::int64_t high) {
    std::vector<T> result(n);
    for (T& v : result) v = static_cast<T>(integer(low, high));
    return result;
  }

 private:
  std::mt19937_64 engine_;
};

inline Layer random_layer(Random& random, std::size_t inputs, std::size_t outputs) {
  Layer layer;
  layer.inputs = inputs;
  layer.outputs = outputs;
  layer.weights = random.integers<std::int8_t>(inputs * outputs, -127, 127);
  layer.bias = random.integers<std::int32_t>(outputs, -1000, 1000);
  layer.multipliers = random.integers<std::int32_t>(outputs, 1 << 12, 1 << 16);
  layer.shift = 22;
  for (std::size_t i = 0; i < layer.table.size(); ++i) {
    layer.table[i] = static_cast<std::uint8_t>(i);
  }
  return layer;
}

inline Codebook random_codebook(Random& random, std::size_t width, std::size_t dim,
                                std::int8_t span = 127) {
  return {width, random.integers<std::int8_t>(dim / width * 256 * width, -span, span)};
}

// With codebooks of words of two and three numbers.
inline std::shared_ptr<const Encoder> random_encoder(std::size_t bits = 64, std::size_t dim = 12,
                                                     std::uint32_t seed = 1) {
  Random random(seed);
  std::vector<Layer> layers = {random_layer(random, bits, 40), random_layer(random, 40, dim)};
  std::vector<Codebook> codebooks = {random_codebook(random, 2, dim),
                                     random_codebook(random, 3, dim)};
  return std::make_shared<const Encoder>(Encoder({"tiny", "test", "", "", {}}, std::move(layers),
                                                 {dim / 2, dim}, 1.0f, std::move(codebooks)));
}

}  // namespace protomark::test
