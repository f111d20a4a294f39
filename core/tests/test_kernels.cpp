// Every instruction set that runs here gives the bytes of plain C++, also on extreme values.
#include "kernels/kernels.h"

#include "check.h"
#include "random.h"

namespace {

using namespace protomark;
using kernels::Kernels;

template <typename T>
std::vector<T> values(test::Random& random, std::size_t n, int style, std::int64_t low,
                      std::int64_t high) {
  if (style == 1) return std::vector<T>(n, static_cast<T>(low));
  if (style == 2) return std::vector<T>(n, static_cast<T>(high));
  return random.integers<T>(n, low, high);
}

void compare_dense(const Kernels& set, test::Random& random, std::size_t inputs,
                   std::size_t outputs, std::size_t n, int style) {
  const auto weights = values<std::int8_t>(random, inputs * outputs, style, -128, 127);
  const auto bias = random.integers<std::int32_t>(outputs, -100000, 100000);
  const auto x = values<std::uint8_t>(random, inputs * n, style, style == 1 ? 255 : 0, 255);
  const kernels::PackedLayer layer{weights.data(), bias.data(), inputs, outputs};
  for (std::size_t wanted = 16; wanted <= outputs; wanted += 16) {
    std::vector<std::int32_t> a(n * wanted), b(n * wanted);
    kernels::portable.dense(layer, x.data(), n, wanted, a.data());
    set.dense(layer, x.data(), n, wanted, b.data());
    CHECK(a == b);
  }
}

void compare_codes(const Kernels& set, test::Random& random, std::size_t dim, std::size_t blocks,
                   int style) {
  const std::size_t rows = 16 * blocks;
  const auto packed = values<std::int8_t>(random, rows * dim, style, -127, 127);
  const auto query = values<std::uint8_t>(random, dim, style, 1, 255);
  std::vector<std::int32_t> a(rows), b(rows);
  kernels::portable.code_offsets(packed.data(), blocks, dim, a.data());
  set.code_offsets(packed.data(), blocks, dim, b.data());
  CHECK(a == b);
  for (const std::int32_t limit : {INT32_MIN, -20000, 0, 100000, 1 << 25}) {
    std::vector<std::uint32_t> rows_a(rows), rows_b(rows);
    std::vector<std::int32_t> found_a(rows), found_b(rows);
    const std::size_t n = kernels::portable.code_scan(
        query.data(), packed.data(), blocks, dim, a.data(), limit, {rows_a.data(), found_a.data()});
    CHECK(set.code_scan(query.data(), packed.data(), blocks, dim, a.data(), limit,
                        {rows_b.data(), found_b.data()}) == n);
    CHECK(rows_a == rows_b);
    CHECK(found_a == found_b);
    CHECK(limit != 1 << 25 || n == rows);
  }
}

// Not a multiple of a vector's length, and garbage where the padding is.
void compare_unpack4(const Kernels& set, test::Random& random, std::size_t dim,
                     std::size_t blocks) {
  const std::size_t stride = (dim + 3) / 4 * 4;
  const auto packed = random.integers<std::uint8_t>(blocks * 16 * ((dim + 7) / 8 * 4), 0, 255);
  for (int half_step = 1; half_step <= 8; ++half_step) {
    // One more block, which must stay as it is.
    std::vector<std::int8_t> expected((blocks + 1) * 16 * stride, 99), codes = expected;
    for (std::size_t row = 0; row < 16 * blocks; ++row) {
      const std::size_t block = row / 16, lane = row % 16;
      for (std::size_t d = 0; d < stride; ++d) {
        const std::uint8_t byte =
            packed[block * 16 * ((dim + 7) / 8 * 4) + d / 8 * 64 + lane * 4 + d % 4];
        const int u = d % 8 < 4 ? byte % 16 : byte / 16;
        expected[block * 16 * stride + d / 4 * 64 + lane * 4 + d % 4] =
            static_cast<std::int8_t>(d < dim ? half_step * (2 * u - 15) : 0);
      }
    }
    set.code_unpack4(packed.data(), blocks, dim, half_step, codes.data());
    CHECK(codes == expected);
  }
}

void compare_hamming(const Kernels& set, test::Random& random, std::size_t words,
                     std::size_t blocks, int style) {
  auto packed = random.integers<std::uint64_t>(8 * words * blocks, 0, INT64_MAX);
  auto query = random.integers<std::uint64_t>(words, 0, INT64_MAX);
  if (style > 0) std::fill(packed.begin(), packed.end(), ~std::uint64_t{0});
  if (style == 2) std::fill(query.begin(), query.end(), 0);
  const std::size_t rows = 8 * blocks;
  for (const std::int32_t limit : {0, static_cast<std::int32_t>(32 * words), 1 << 16}) {
    std::vector<std::uint32_t> rows_a(rows), rows_b(rows);
    std::vector<std::int32_t> found_a(rows), found_b(rows);
    const std::size_t n = kernels::portable.hamming_scan(query.data(), packed.data(), blocks, words,
                                                         limit, {rows_a.data(), found_a.data()});
    CHECK(set.hamming_scan(query.data(), packed.data(), blocks, words, limit,
                           {rows_b.data(), found_b.data()}) == n);
    CHECK(rows_a == rows_b);
    CHECK(found_a == found_b);
    CHECK(limit != 1 << 16 || n == rows);
  }
}

}  // namespace

int main() {
  test::Random random(7);
  int sets = 0;
  for (const char* const* name = kernels::names(); *name != nullptr; ++name) {
    const Kernels* set = kernels::find(*name);
    CHECK(set != nullptr);
    std::printf("%s\n", *name);
    ++sets;
    for (int style = 0; style < 3; ++style) {
      for (const std::size_t inputs : {16, 64, 1024}) {
        for (const std::size_t outputs : {16, 48}) {
          for (const std::size_t n : {1, 7, 8, 19}) {
            compare_dense(*set, random, inputs, outputs, n, style);
          }
        }
      }
      for (const std::size_t dim : {4, 12, 32, 256}) {
        for (const std::size_t blocks : {0, 1, 5}) compare_codes(*set, random, dim, blocks, style);
      }
      for (std::size_t dim = 1; dim <= 33; ++dim) compare_unpack4(*set, random, dim, 3);
      for (const std::size_t blocks : {0, 1}) compare_unpack4(*set, random, 256, blocks);
      for (const std::size_t words : {1, 4, 8, 16}) {
        for (const std::size_t blocks : {0, 1, 9}) {
          compare_hamming(*set, random, words, blocks, style);
        }
      }
    }
  }
  CHECK(sets > 0);
  CHECK(kernels::find("vax") == nullptr);
  return check::result();
}
