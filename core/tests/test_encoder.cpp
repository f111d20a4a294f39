#include "protomark/encoder.h"

#include <algorithm>

#include "check.h"
#include "protomark/error.h"
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

}  // namespace

int main() {
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
