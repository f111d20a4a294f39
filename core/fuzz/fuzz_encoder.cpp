#include <algorithm>
#include <vector>

#include "aligned_copy.h"
#include "expect.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;

namespace {

// The definition in protomark/encoder.h.
std::vector<std::int8_t> reference(const Encoder& encoder, const std::uint8_t* descriptor) {
  std::vector<std::int64_t> x;
  for (std::size_t b = 0; b < encoder.bits(); ++b) x.push_back(descriptor[b / 8] >> (b % 8) & 1);
  std::vector<std::int8_t> code;
  for (const Layer& layer : encoder.layers()) {
    const bool last = &layer == &encoder.layers().back();
    std::vector<std::int64_t> next;
    for (std::size_t o = 0; o < layer.outputs; ++o) {
      std::int64_t sum = layer.bias[o];
      for (std::size_t i = 0; i < layer.inputs; ++i) {
        sum += layer.weights[o * layer.inputs + i] * x[i];
      }
      const __int128 product = static_cast<__int128>(sum) * layer.multipliers[o];
      const __int128 t = (product + (__int128{1} << (layer.shift - 1))) >> layer.shift;
      if (last) {
        code.push_back(static_cast<std::int8_t>(std::clamp<__int128>(t, -127, 127)));
      } else {
        next.push_back(
            layer.table[static_cast<std::size_t>(std::clamp<__int128>(t, -128, 127) + 128)]);
      }
    }
    x = std::move(next);
  }
  return code;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    const Encoder encoder = Encoder::parse(input.bytes(), "input");
    test::Random random(3);
    const std::size_t n = 5, bytes = encoder.bytes();
    auto descriptors = random.integers<std::uint8_t>(n * bytes, 0, 255);
    std::fill_n(descriptors.begin(), bytes, std::uint8_t{255});
    for (const std::size_t dim : encoder.dims()) {
      const auto codes = encoder.encode({descriptors.data(), n, bytes}, dim);
      for (std::size_t i = 0; i < n; ++i) {
        const auto wanted = reference(encoder, &descriptors[i * bytes]);
        EXPECT(std::equal(codes.row(i), codes.row(i) + dim, wanted.begin()));
      }
    }
    const auto written = encoder.serialize();
    const Encoder again = Encoder::parse(written, "written");
    EXPECT(again.identity() == encoder.identity() && again.codebooks() == encoder.codebooks());
  } catch (const FileError&) {
  }
  return 0;
}
