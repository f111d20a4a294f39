#include "protomark/protomark.h"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <utility>
#include <vector>

#include "check.h"
#include "kernels/kernels.h"
#include "random.h"

using namespace protomark;

namespace {

// The definition in encoder.h, one number at a time.
std::vector<std::int8_t> reference(const Encoder& encoder, const std::uint8_t* descriptor) {
  std::vector<std::int64_t> x;
  for (std::size_t b = 0; b < encoder.bits(); ++b) x.push_back(descriptor[b / 8] >> (b % 8) & 1);
  for (std::size_t l = 0; l < encoder.layers().size(); ++l) {
    const Layer& layer = encoder.layers()[l];
    std::vector<std::int64_t> next;
    for (std::size_t o = 0; o < layer.outputs; ++o) {
      std::int64_t sum = layer.bias[o];
      for (std::size_t i = 0; i < layer.inputs; ++i) {
        sum += layer.weights[o * layer.inputs + i] * x[i];
      }
      const std::int64_t half = std::int64_t{1} << (layer.shift - 1);
      const std::int64_t t = (sum * layer.multipliers[o] + half) >> layer.shift;
      next.push_back(
          l + 1 < encoder.layers().size()
              ? layer.table[static_cast<std::size_t>(std::clamp<std::int64_t>(t, -128, 127) + 128)]
              : std::clamp<std::int64_t>(t, -127, 127));
    }
    x = std::move(next);
  }
  return {x.begin(), x.end()};
}

// A network of random layers whose results neither vanish nor all saturate.
Encoder network(std::uint32_t seed, const std::vector<std::size_t>& widths, int shift) {
  test::Random random(seed);
  std::vector<Layer> layers;
  for (std::size_t l = 1; l < widths.size(); ++l) {
    Layer layer = test::random_layer(random, widths[l - 1], widths[l]);
    // The multipliers of random_layer belong to a shift of 22.
    layer.shift = shift;
    for (std::int32_t& m : layer.multipliers) {
      const std::int64_t scaled = shift < 22 ? m >> (22 - shift) : std::int64_t{m} << (shift - 22);
      m = static_cast<std::int32_t>(std::clamp<std::int64_t>(scaled, 1, INT32_MAX));
    }
    layer.table = {};
    for (auto& t : layer.table) t = static_cast<std::uint8_t>(random.integer(0, 255));
    layers.push_back(std::move(layer));
  }
  return {{"tiny", "test", "", "", {}}, std::move(layers), {widths.back()}, 1.0f};
}

void compare(const Encoder& encoder, std::size_t n, int threads, test::Random& random) {
  const std::size_t bytes = encoder.bytes(), dim = encoder.dim();
  auto descriptors = random.integers<std::uint8_t>(n * bytes, 0, 255);
  // All bits, none.
  for (std::size_t b = 0; b < bytes && n > 1; ++b) {
    descriptors[b] = 255;
    descriptors[bytes + b] = 0;
  }
  std::vector<std::int8_t> codes(n * dim, 99);
  encoder.encode({descriptors.data(), n, bytes}, {codes.data(), n, dim}, threads);
  // The first, the last and a few between, as the reference is slow.
  for (std::size_t i = 0; i < n; i += i < 20 || i + 20 > n ? 1 : 13) {
    const auto expected = reference(encoder, &descriptors[i * bytes]);
    CHECK(std::equal(expected.begin(), expected.end(), &codes[i * dim]));
  }
}

}  // namespace

int main() {
  if (const char* isa = std::getenv("PROTOMARK_ISA"); isa != nullptr && *isa != 0) {
    if (kernels::find(isa) == nullptr) return 77;  // not on this machine: skipped
  }
  const auto encoder = test::random_encoder(488, 20);
  test::Random random(2);
  const std::size_t n = 150;
  const auto descriptors = random.integers<std::uint8_t>(n * 61, 0, 255);
  std::vector<std::int8_t> codes(n * 20), prefix(n * 10);
  encoder->encode({descriptors.data(), n, 61}, {codes.data(), n, 20}, 2);
  encoder->encode({descriptors.data(), n, 61}, {prefix.data(), n, 10});
  for (std::size_t i = 0; i < n; ++i) {
    const auto expected = reference(*encoder, &descriptors[i * 61]);
    CHECK(std::equal(expected.begin(), expected.end(), &codes[i * 20]));
    CHECK(std::equal(&prefix[i * 10], &prefix[i * 10] + 10, &codes[i * 20]));
  }

  // Sizes around those at which the method changes. Each instruction set has its own run
  // (PROTOMARK_ISA).
  const Encoder wide = network(3, {512, 80, 40}, 32);
  for (const std::size_t size :
       {0, 1, 15, 16, 17, 63, 64, 65, 127, 128, 129, 511, 512, 513, 1000}) {
    compare(wide, size, 1, random);
    compare(wide, size, 3, random);
  }
  for (const std::size_t size : {1, 20}) {
    compare(network(4, {64, 12}, 32), size, 1, random);                // a single layer
    compare(network(5, {1024, 70, 33, 130, 9}, 32), size, 1, random);  // many
    compare(network(6, {72, 64, 256}, 20), size, 1, random);           // a small shift
    compare(network(7, {1000, 65, 1}, 37), size, 1, random);
    // Sums that leave 16 bits.
    for (const std::int8_t weight : {-128, 127}) {
      Layer first = test::random_layer(random, 1016, 66);
      std::fill(first.weights.begin(), first.weights.end(), weight);
      first.multipliers.assign(66, 1 << 22);
      first.shift = 32;
      Layer second = test::random_layer(random, 66, 20);
      const Encoder large({"tiny", "test", "", "", {}}, {first, second}, {20}, 1.0f);
      compare(large, size, 1, random);
    }
  }

  const auto bytes = encoder->serialize();
  const Encoder read = Encoder::parse(bytes, "memory");
  CHECK(read.identity() == encoder->identity());
  CHECK(read.info().name == "tiny");
  CHECK(read.dims() == encoder->dims());
  CHECK(check::throws<FileError>(
      [&] { Encoder::parse(std::span(bytes).first(bytes.size() - 64), "memory"); }, "cut off"));
  CHECK(check::throws<FileError>([&] { Encoder::load("/nowhere/x.pme"); }, "cannot be read"));
  return check::result();
}
