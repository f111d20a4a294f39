// Every instruction set that runs here gives the bytes of plain C++, also on extreme values.
#include "kernels/kernels.h"

#include <algorithm>
#include <cstring>
#include <limits>

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

constexpr std::size_t kOutputs = kernels::kOutputs;

// Weights so large that sums just stay within 16 bits: 256 of them are set at most.
void compare_bits(const Kernels& set, test::Random& random, std::size_t count, std::size_t n,
                  int style) {
  const std::int64_t most = count <= 4 ? 128 : 32;
  const auto weights = values<std::int8_t>(random, count * 64 * kOutputs, style, -most, most - 1);
  std::vector<std::uint64_t> words(count * n);
  std::vector<std::int16_t> expected(n * kOutputs);
  std::vector<std::vector<std::uint16_t>> bits(n);
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t j = 0; j < count * 64; ++j) {
      if (style == 0 && random.integer(0, 1) == 0) continue;
      words[j / 64 * n + i] |= std::uint64_t{1} << (j % 64);
      bits[i].push_back(static_cast<std::uint16_t>(j));
      for (std::size_t o = 0; o < kOutputs; ++o) {
        expected[i * kOutputs + o] =
            static_cast<std::int16_t>(expected[i * kOutputs + o] + weights[j * kOutputs + o]);
      }
    }
  }
  // What is there before does not count; nothing is written behind the end.
  std::vector<std::int16_t> sums(n * kOutputs + 1, 99);
  set.bit_sums(weights.data(), words.data(), count, n, sums.data());
  CHECK(std::equal(expected.begin(), expected.end(), sums.begin()));
  CHECK(sums.back() == 99);
  std::fill(sums.begin(), sums.end(), 99);
  for (std::size_t i = 0; i < n; ++i) {
    set.bit_sum(weights.data(), bits[i].data(), bits[i].size(), &sums[i * kOutputs]);
  }
  CHECK(std::equal(expected.begin(), expected.end(), sums.begin()));
  CHECK(sums.back() == 99);
}

void compare_dense(const Kernels& set, test::Random& random, std::size_t inputs, std::size_t n,
                   int style) {
  const auto weights = values<std::int8_t>(random, inputs * kOutputs, style, -128, 127);
  const std::size_t stride = inputs + 3;
  const auto x = values<std::uint8_t>(random, stride * n, style, style == 1 ? 255 : 0, 255);
  for (std::size_t outputs = 16; outputs <= kOutputs; outputs += 16) {
    // Other outputs stay as they are.
    std::vector<std::int32_t> expected(n * kOutputs, 99), sums = expected;
    for (std::size_t i = 0; i < n; ++i) {
      for (std::size_t o = 0; o < outputs; ++o) {
        std::int32_t sum = 0;
        for (std::size_t j = 0; j < inputs; ++j) {
          sum +=
              x[i * stride + j] * weights[o / 16 * 16 * inputs + j / 4 * 64 + o % 16 * 4 + j % 4];
        }
        expected[i * kOutputs + o] = sum;
      }
    }
    set.dense(weights.data(), inputs, x.data(), stride, n, outputs, sums.data());
    CHECK(sums == expected);
  }
}

template <typename Sum>
void compare_activation(void (*activate)(const kernels::Activation&, const Sum*, std::size_t,
                                         std::uint8_t*, std::size_t),
                        test::Random& random, int shift, std::size_t n, int style) {
  const auto table = random.integers<std::uint8_t>(256, 0, 255);
  // Style 0: results on both sides of -128 and 127; styles 1 and 2: extreme numbers.
  const std::int64_t reach = std::min<std::int64_t>(INT32_MAX / 2, std::int64_t{1} << 20);
  const std::int64_t sum = style == 0 ? reach : INT32_MAX / 2;
  const std::int64_t fit = (std::int64_t{512} << shift >> 20) + 1;
  const std::int64_t most =
      style == 0 && shift < 42 ? std::min<std::int64_t>(fit, INT32_MAX) : std::int64_t{INT32_MAX};
  const auto bias = values<std::int32_t>(random, kOutputs, style, -sum - 1, sum);
  const auto multipliers =
      values<std::int32_t>(random, kOutputs, style == 0 ? 0 : 2, (most + 1) / 2, most);
  const std::int64_t low = std::max<std::int64_t>(std::numeric_limits<Sum>::min(), -sum);
  const std::int64_t high = std::min<std::int64_t>(std::numeric_limits<Sum>::max(), sum);
  auto sums = values<Sum>(random, n * kOutputs, style, low, high);
  // Small sums, among them those that are halves once scaled.
  for (std::size_t i = 0; i < sums.size(); i += 3) {
    sums[i] = static_cast<Sum>(random.integer(-300, 300));
  }
  const std::size_t stride = kOutputs + 5;
  std::vector<std::uint8_t> expected(n * stride, 99), next = expected;
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t o = 0; o < kOutputs; ++o) {
      const std::int64_t s = std::int64_t{sums[i * kOutputs + o]} + bias[o];
      const std::int64_t t = (s * multipliers[o] + (std::int64_t{1} << (shift - 1))) >> shift;
      expected[i * stride + o] =
          table[static_cast<std::size_t>(std::clamp<std::int64_t>(t, -128, 127) + 128)];
    }
  }
  activate({bias.data(), multipliers.data(), table.data(), shift}, sums.data(), n, next.data(),
           stride);
  CHECK(next == expected);
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
      for (const std::size_t count : {1, 4, 8, 16}) {
        for (const std::size_t n : {0, 1, 2, 7, 33}) compare_bits(*set, random, count, n, style);
      }
      for (const std::size_t inputs : {64, 192, 4096}) {
        for (const std::size_t n : {0, 1, 7, 8, 19}) {
          compare_dense(*set, random, inputs, n, style);
        }
      }
      for (int shift = std::strcmp(*name, "portable") == 0 ? 1 : 32; shift <= 62; ++shift) {
        for (const std::size_t n : {0, 1, 6}) {
          compare_activation(set->activate16, random, shift, n, style);
          compare_activation(set->activate32, random, shift, n, style);
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
