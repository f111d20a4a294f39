// Codes by their definition in protomark/encoder.h, one number at a time.
#pragma once

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstring>

#include "random.h"

namespace protomark::test {

// Descriptors that an encoder takes, one after the other. Floats are halves of quantised numbers,
// up to twice as large as the largest one; the first descriptor has the largest numbers of all.
inline std::vector<std::uint8_t> random_descriptors(Random& random, const Encoder& encoder,
                                                    std::size_t n) {
  const std::size_t bytes = encoder.bytes();
  auto result = random.integers<std::uint8_t>(n * bytes, 0, 255);
  if (n != 0) std::fill_n(result.begin(), bytes, std::uint8_t{255});
  if (encoder.input().kind != InputKind::float32) return result;
  for (std::size_t i = 0; i < result.size(); i += sizeof(float)) {
    const auto twice = static_cast<float>(random.integer(-508, 508));
    const float f = std::clamp(twice / 2 / encoder.input().scale, -FLT_MAX, FLT_MAX);
    const float largest = i % 8 == 0 ? FLT_MAX : -FLT_MAX;
    std::memcpy(&result[i], i < bytes ? &largest : &f, sizeof f);
  }
  return result;
}

inline std::vector<std::int8_t> reference_code(const Encoder& encoder, const std::uint8_t* from) {
  std::vector<std::int64_t> x;
  for (std::size_t i = 0; i < encoder.inputs(); ++i) {
    if (encoder.input().kind == InputKind::bits) {
      x.push_back(from[i / 8] >> (i % 8) & 1);
    } else if (encoder.input().kind == InputKind::uint8) {
      x.push_back(from[i]);
    } else {
      float f;
      std::memcpy(&f, from + i * sizeof f, sizeof f);
      const float scaled = f * encoder.input().scale;
      x.push_back(128 + std::lrint(std::clamp(scaled, -127.0f, 127.0f)));
    }
  }
  for (const Layer& layer : encoder.layers()) {
    std::vector<std::int64_t> next;
    for (std::size_t o = 0; o < layer.outputs; ++o) {
      std::int64_t sum = layer.bias[o];
      for (std::size_t i = 0; i < layer.inputs; ++i) {
        sum += layer.weights[o * layer.inputs + i] * x[i];
      }
      const std::int64_t half = std::int64_t{1} << (layer.shift - 1);
      const std::int64_t t = (sum * layer.multipliers[o] + half) >> layer.shift;
      next.push_back(
          &layer != &encoder.layers().back()
              ? layer.table[static_cast<std::size_t>(std::clamp<std::int64_t>(t, -128, 127) + 128)]
              : std::clamp<std::int64_t>(t, -127, 127));
    }
    x = std::move(next);
  }
  return {x.begin(), x.end()};
}

}  // namespace protomark::test
