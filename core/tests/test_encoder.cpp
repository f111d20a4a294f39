#include "protomark/protomark.h"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <utility>
#include <vector>

#include "check.h"
#include "kernels/kernels.h"
#include "reference.h"

using namespace protomark;

namespace {

// A network of random layers whose results neither vanish nor all saturate.
Encoder network(std::uint32_t seed, const std::vector<std::size_t>& widths, int shift,
                EncoderInput input = {}) {
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
  return {{"tiny", "test", "", "", {}}, std::move(layers), {widths.back()}, 1.0f, {}, input};
}

void compare(const Encoder& encoder, std::size_t n, int threads, test::Random& random) {
  const std::size_t bytes = encoder.bytes(), dim = encoder.dim();
  auto descriptors = test::random_descriptors(random, encoder, n);
  if (encoder.input().kind == InputKind::bits && n > 1) std::fill_n(&descriptors[bytes], bytes, 0);
  std::vector<std::int8_t> codes(n * dim, 99);
  encoder.encode({descriptors.data(), n, bytes}, {codes.data(), n, dim}, threads);
  // The first, the last and a few between, as the reference is slow.
  for (std::size_t i = 0; i < n; i += i < 20 || i + 20 > n ? 1 : 13) {
    const auto expected = test::reference_code(encoder, &descriptors[i * bytes]);
    CHECK(std::equal(expected.begin(), expected.end(), &codes[i * dim]));
  }
}

constexpr EncoderInput kBytes{InputKind::uint8, 0};

// Vectors: widths that fill a step of the kernels and that do not, and sums at the limits.
void compare_vectors(test::Random& random) {
  for (const EncoderInput input : {kBytes, EncoderInput{InputKind::float32, 30.5f}}) {
    for (const std::size_t width : {16, 17, 64, 128, 130, 1024}) {
      const Encoder encoder = network(8, {width, 130, 40}, 34, input);
      CHECK(encoder.inputs() == width && encoder.bits() == 8 * encoder.bytes());
      for (const std::size_t size : {0, 1, 63, 65, 600}) compare(encoder, size, 3, random);
    }
    compare(network(9, {128, 12}, 34, input), 20, 1, random);  // a single layer
    compare(network(9, {33, 12}, 20, input), 20, 1, random);   // a small shift
    for (const std::int8_t weight : {-128, 127}) {
      Layer layer = test::random_layer(random, 1024, 66);
      std::fill(layer.weights.begin(), layer.weights.end(), weight);
      layer.multipliers.assign(66, 1 << 12);
      layer.shift = 32;
      const Encoder large({"tiny", "test", "", "", {}}, {layer}, {66}, 1.0f, {}, input);
      compare(large, 20, 1, random);
      layer.bias[65] = weight > 0 ? INT32_MAX - 255 * 1024 * 127 + 1 : INT32_MIN;
      CHECK(check::throws<std::invalid_argument>(
          [&] { Encoder({"tiny", "test", "", "", {}}, {layer}, {66}, 1.0f, {}, input); },
          "sums of output 65 could leave 32 bits"));
    }
  }
  // Scales so small and so large that products vanish or overflow.
  const auto of_scale = [](float scale) {
    return network(10, {16, 12}, 34, {InputKind::float32, scale});
  };
  compare(of_scale(1e-36f), 30, 1, random);
  compare(of_scale(1e36f), 30, 1, random);
  for (const float scale : {0.0f, -1.0f, HUGE_VALF, NAN}) {
    CHECK(check::throws<std::invalid_argument>([&] { of_scale(scale); }, "input_scale must be"));
  }
}

// Vectors that say nothing are refused, the first of them by its number.
void refuse_vectors(test::Random& random) {
  const Encoder floats = network(11, {20, 12}, 34, {InputKind::float32, 2.0f});
  const Encoder integers = network(11, {20, 12}, 34, kBytes);
  const auto refused = [&](const Encoder& encoder, const std::vector<float>& numbers,
                           const char* why) {
    const std::size_t n = 500, bytes = encoder.bytes();
    auto descriptors = test::random_descriptors(random, encoder, n);
    for (const std::size_t row : {499, 312, 311}) {
      std::memcpy(&descriptors[row * bytes], numbers.data(), bytes);
    }
    for (const int threads : {1, 3}) {
      CHECK(check::throws<std::invalid_argument>(
          [&] { encoder.encode({descriptors.data(), n, bytes}, 0, threads); }, why));
    }
    // A whole map stays as it was, also if some were good; floats may be at any address.
    descriptors.insert(descriptors.begin(), 1, 0);
    PrototypeMap map(std::make_shared<const Encoder>(encoder));
    const std::vector<std::int64_t> ids(n, 7);
    CHECK(check::throws<std::invalid_argument>([&] { map.add(ids, {&descriptors[1], n, bytes}); },
                                               why));
    CHECK(map.size() == 0);
    map.add(std::span(ids).first(311), {&descriptors[1], 311, bytes});
    CHECK(map.size() == 1);
  };
  std::vector<float> numbers(20);
  refused(integers, numbers, "descriptors: row 311 is all zeros");
  refused(floats, numbers, "descriptors: row 311 is all zeros once quantised");
  numbers[19] = -0.25f;  // half a quantised unit: 0 is the even one
  refused(floats, numbers, "descriptors: row 311 is all zeros once quantised");
  for (const float bad : {NAN, -NAN, HUGE_VALF, -HUGE_VALF}) {
    numbers[19] = bad;
    refused(floats, numbers, "descriptors: row 311 has a NaN or an infinity");
  }
  for (const std::size_t width : {15, 1025}) {
    CHECK(check::throws<std::invalid_argument>([&] { network(12, {width, 12}, 34, kBytes); },
                                               "has 16 to 1024 numbers"));
  }
  CHECK(check::throws<std::invalid_argument>(
      [&] { network(12, {64, 12}, 34, {InputKind::uint8, 1.0f}); }, "and 0 for others, not 1"));
}

void read_and_write() {
  for (const EncoderInput input : {kBytes, EncoderInput{InputKind::float32, 0.3f}}) {
    const Encoder encoder = network(13, {128, 12}, 34, input);
    const auto bytes = encoder.serialize();
    const Encoder read = Encoder::parse(bytes, "memory");
    CHECK(read.input() == input && read.identity() == encoder.identity());
    CHECK(encoder.identity() != network(13, {128, 12}, 34).identity());
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
    const auto expected = test::reference_code(*encoder, &descriptors[i * 61]);
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

  compare_vectors(random);
  refuse_vectors(random);
  read_and_write();

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
