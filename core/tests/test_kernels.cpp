// Every instruction set that runs here gives the bytes of plain C++ and the hits of the definition,
// also for extreme values.
#include "kernels/kernels.h"

#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>
#include <tuple>

#include "check.h"
#include "random.h"

#ifdef PROTOMARK_EMULATE_AMX
namespace protomark::kernels {
extern const Kernels emulated_amx;  // see CMakeLists.txt
}
#endif

namespace protomark::kernels {

bool operator<(const Hit& a, const Hit& b) {
  return std::tie(a.query, a.row) < std::tie(b.query, b.row);
}

bool operator==(const Hit& a, const Hit& b) {
  return a.query == b.query && a.row == b.row && a.distance == b.distance;
}

}  // namespace protomark::kernels

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

// Weights with which sums of up to 256 bits just stay within 16 bits.
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
  // Earlier content does not count, and nothing is written behind the end.
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

// All hits of a scan, whose step is scan(block, hits), in order.
template <typename Scan>
std::vector<kernels::Hit> all_hits(std::size_t blocks, const Scan& scan) {
  std::vector<kernels::Hit> hits(kernels::kHitRoom), all;
  for (std::size_t block = 0; block < blocks;) {
    const std::size_t before = block;
    const std::size_t found = scan(&block, hits.data());
    CHECK(before < block && block <= blocks);
    CHECK(found <= hits.size());
    CHECK(found >= kernels::kHitsEnough || block == blocks);
    all.insert(all.end(), hits.begin(), hits.begin() + static_cast<std::ptrdiff_t>(found));
  }
  std::sort(all.begin(), all.end());
  return all;
}

// Limits that include all rows, none, and just the distance of a row.
std::vector<std::int32_t> some_limits(test::Random& random,
                                      const std::vector<std::vector<std::int32_t>>& distances) {
  std::vector<std::int32_t> limits;
  for (const auto& row : distances) {
    const std::int32_t one = row.empty() ? 0 : row[random.integer(0, row.size() - 1)];
    const std::int32_t choice[] = {INT32_MIN, INT32_MIN + 1, INT32_MAX, 0, one, one, one - 1};
    limits.push_back(choice[random.integer(0, 6)]);
  }
  return limits;
}

std::vector<kernels::Hit> expected_hits(const std::vector<std::vector<std::int32_t>>& distances,
                                        const std::vector<std::int32_t>& limits) {
  std::vector<kernels::Hit> hits;
  for (std::uint32_t q = 0; q < limits.size(); ++q) {
    for (std::uint32_t r = 0; r < distances[q].size(); ++r) {
      if (distances[q][r] <= limits[q]) hits.push_back({q, r, distances[q][r]});
    }
  }
  return hits;
}

void compare_codes(const Kernels& set, test::Random& random, std::size_t dim, std::size_t prefix,
                   std::size_t blocks, std::size_t n, int style) {
  const std::size_t rows = 16 * blocks;
  const auto packed = values<std::int8_t>(random, rows * dim, style, -128, 127);
  const auto queries = values<std::uint8_t>(random, n * dim, random.integer(0, 2), 1, 255);
  std::vector<std::vector<std::int32_t>> distances(n, std::vector<std::int32_t>(rows));
  for (std::size_t q = 0; q < n; ++q) {
    for (std::size_t r = 0; r < rows; ++r) {
      for (std::size_t d = 0; d < dim; ++d) {
        const int p = packed[r / 16 * 16 * dim + d / 4 * 64 + r % 16 * 4 + d % 4];
        distances[q][r] += p * p - 2 * p * (queries[q * dim + d] - 128);
      }
    }
  }
  std::vector<std::int32_t> rest_norms(n);
  for (std::size_t q = 0; q < n; ++q) {
    for (std::size_t d = prefix; d < dim; ++d) {
      rest_norms[q] += (queries[q * dim + d] - 128) * (queries[q * dim + d] - 128);
    }
  }
  std::vector<std::int32_t> biases(rows), prefix_biases(rows);
  set.code_biases(packed.data(), blocks, dim, prefix, biases.data(), prefix_biases.data());
  std::size_t steps_in_full = 0;
  for (int repeat = 0; repeat < 6; ++repeat) {
    // A few queries need no biases.
    const bool biased = n > kernels::kFewQueries || repeat % 2 == 0;
    const auto limits = some_limits(random, distances);
    const auto found = all_hits(blocks, [&](std::size_t* block, kernels::Hit* hits) {
      return set.code_scan({queries.data(), limits.data(), rest_norms.data(), n, &steps_in_full},
                           {packed.data(), biased ? biases.data() : nullptr, prefix_biases.data(),
                            blocks, dim, prefix},
                           block, hits);
    });
    CHECK(found == expected_hits(distances, limits));
  }
}

void compare_decode(const Kernels& set, test::Random& random, std::size_t width, std::size_t words,
                    std::size_t blocks) {
  const std::size_t dim = width * words, stride = (dim + 3) / 4 * 4;
  const auto packed = random.integers<std::uint8_t>(blocks * 16 * words, 0, 255);
  auto table = random.integers<std::int8_t>(stride * 256, -127, 127);
  std::fill(table.begin() + static_cast<std::ptrdiff_t>(dim * 256), table.end(), 0);
  // One more block, which must stay as it is.
  std::vector<std::int8_t> expected((blocks + 1) * 16 * stride, 99), codes = expected;
  for (std::size_t row = 0; row < 16 * blocks; ++row) {
    const std::size_t block = row / 16, lane = row % 16;
    for (std::size_t d = 0; d < stride; ++d) {
      const std::size_t word = std::min(d / width, words - 1);
      expected[block * 16 * stride + d / 4 * 64 + lane * 4 + d % 4] =
          table[d * 256 + packed[(block * words + word) * 16 + lane]];
    }
  }
  set.code_decode(packed.data(), blocks, dim, width, table.data(), codes.data());
  CHECK(codes == expected);
}

// Few values give many ties.
void compare_nearest_words(const Kernels& set, test::Random& random, std::size_t n, int span) {
  const auto words = random.integers<std::int8_t>(256 * 4, -span, span);
  const auto numbers = random.integers<std::uint8_t>(4 * n, 128 - span, 128 + span);
  std::vector<std::int32_t> keys(256);
  set.code_biases(words.data(), 16, 4, 4, keys.data(), nullptr);
  for (int w = 0; w < 256; ++w) keys[w] = keys[w] * 256 + 255 - w;
  std::vector<std::uint8_t> expected(n + 1, 99), nearest = expected;
  for (std::size_t i = 0; i < n; ++i) {
    std::int32_t best = INT32_MAX;
    for (std::size_t w = 0; w < 256; ++w) {
      std::int32_t distance = 0;
      for (std::size_t j = 0; j < 4; ++j) {
        const int apart = words[4 * w + j] - (numbers[4 * i + j] - 128);
        distance += apart * apart;
      }
      if (distance >= best) continue;
      best = distance;
      expected[i] = static_cast<std::uint8_t>(w);
    }
  }
  set.nearest_words(words.data(), keys.data(), numbers.data(), n, nearest.data());
  CHECK(nearest == expected);
}

void compare_hamming(const Kernels& set, test::Random& random, std::size_t words,
                     std::size_t blocks, std::size_t n, int style) {
  const std::size_t rows = 8 * blocks;
  auto packed = random.integers<std::uint64_t>(rows * words, 0, INT64_MAX);
  auto queries = random.integers<std::uint64_t>(n * words, 0, INT64_MAX);
  if (style > 0) std::fill(packed.begin(), packed.end(), ~std::uint64_t{0});
  if (style == 2) std::fill(queries.begin(), queries.end(), 0);
  std::vector<std::vector<std::int32_t>> distances(n, std::vector<std::int32_t>(rows));
  for (std::size_t q = 0; q < n; ++q) {
    for (std::size_t r = 0; r < rows; ++r) {
      for (std::size_t w = 0; w < words; ++w) {
        const std::uint64_t row = packed[r / 8 * 8 * words + w * 8 + r % 8];
        distances[q][r] += std::popcount(queries[q * words + w] ^ row);
      }
    }
  }
  for (int repeat = 0; repeat < 3; ++repeat) {
    const auto limits = some_limits(random, distances);
    const auto found = all_hits(blocks, [&](std::size_t* block, kernels::Hit* hits) {
      return set.hamming_scan({queries.data(), limits.data(), n}, {packed.data(), blocks, words},
                              block, hits);
    });
    CHECK(found == expected_hits(distances, limits));
  }
}

void compare_code_scans(const Kernels& set, test::Random& random) {
  for (int style = 0; style < 3; ++style) {
    for (std::size_t dim = 4; dim <= 256; dim += dim < 72 ? 4 : 28) {
      for (const std::size_t n : {1, 2, 3, 4, 6, 16}) {
        const auto blocks = static_cast<std::size_t>(random.integer(0, 13));
        const auto prefix =
            4 * static_cast<std::size_t>(random.integer(1, static_cast<int>(dim / 4)));
        compare_codes(set, random, dim, prefix, blocks, n, style);
      }
    }
    // Steps are compared in full, and then the prefix again.
    for (const std::size_t n : {4, 15, 16}) compare_codes(set, random, 32, 20, 150, n, style);
  }
}

}  // namespace

int main() {
  test::Random random(7);
  int sets = 0;
  for (const Kernels* set = kernels::all(); set->name != nullptr; ++set) {
    CHECK(kernels::find(set->name) == set);
    std::printf("%s\n", set->name);
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
      for (int shift = std::strcmp(set->name, "portable") == 0 ? 1 : 32; shift <= 62; ++shift) {
        for (const std::size_t n : {0, 1, 6}) {
          compare_activation(set->activate16, random, shift, n, style);
          compare_activation(set->activate32, random, shift, n, style);
        }
      }
      for (const std::size_t width : {1, 2, 3, 4}) {
        for (const std::size_t words : {1, 2, 5, 9, 64}) {
          for (std::size_t blocks = 0; blocks <= 9; ++blocks) {
            compare_decode(*set, random, width, words, blocks);
          }
        }
      }
      for (const int span : {0, 1, 5, 127}) {
        for (const std::size_t n : {0, 1, 16, 100}) compare_nearest_words(*set, random, n, span);
      }
      for (const std::size_t words : {1, 4, 8, 31, 70, 512}) {
        for (const std::size_t n : {1, 7, 8, 16}) {
          const auto blocks = static_cast<std::size_t>(random.integer(0, 9));
          compare_hamming(*set, random, words, blocks, n, style);
        }
      }
    }
    compare_code_scans(*set, random);
  }
#ifdef PROTOMARK_EMULATE_AMX
  if (const Kernels* avx512 = kernels::find("avx512")) {
    std::printf("amx, emulated\n");
    Kernels set = *avx512;
    set.code_scan = kernels::emulated_amx.code_scan;
    compare_code_scans(set, random);
  }
#endif
  CHECK(sets > 0);
  CHECK(kernels::find("vax") == nullptr);
  return check::result();
}
