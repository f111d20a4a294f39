#include <algorithm>
#include <vector>

#include "aligned_copy.h"
#include "expect.h"
#include "protomark/protomark.h"
#include "reference.h"

using namespace protomark;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const fuzz::AlignedCopy input(data, size);
  try {
    const Encoder encoder = Encoder::parse(input.bytes(), "input");
    test::Random random(3);
    const std::size_t n = 5, bytes = encoder.bytes();
    const auto descriptors = test::random_descriptors(random, encoder, n);
    for (const std::size_t dim : encoder.dims()) {
      const auto codes = encoder.encode({descriptors.data(), n, bytes}, dim);
      for (std::size_t i = 0; i < n; ++i) {
        const auto wanted = test::reference_code(encoder, &descriptors[i * bytes]);
        EXPECT(std::equal(codes.row(i), codes.row(i) + dim, wanted.begin()));
      }
    }
    const auto written = encoder.serialize();
    const Encoder again = Encoder::parse(written, "written");
    EXPECT(again.identity() == encoder.identity() && again.codebooks() == encoder.codebooks());
    EXPECT(again.input() == encoder.input());
  } catch (const FileError&) {
  } catch (const std::invalid_argument&) {
    // An input_scale so small that all floats become zeros.
  }
  return 0;
}
