// Plain C++, for every machine; the definition that the others must match.
#include "block_biases.h"
#include "kernels.h"

namespace protomark::kernels {
namespace {

// Outputs that are summed together: with a table of 16 KB for 64 inputs, in the L1 cache.
constexpr std::size_t kHalf = kOutputs / 2;

// The sums of all subsets of 4 inputs, for each 4 of 64 inputs.
void fill_table(const std::int8_t* weights, std::int16_t (*table)[kHalf]) {
  for (std::size_t group = 0; group < 16; ++group, weights += 4 * kOutputs, table += 16) {
    for (std::size_t o = 0; o < kHalf; ++o) table[0][o] = 0;
    for (std::size_t j = 0; j < 4; ++j) {
      const std::size_t bit = std::size_t{1} << j;
      for (std::size_t subset = 0; subset < bit; ++subset) {
        for (std::size_t o = 0; o < kHalf; ++o) {
          table[bit + subset][o] =
              static_cast<std::int16_t>(table[subset][o] + weights[j * kOutputs + o]);
        }
      }
    }
  }
}

void bit_sums(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
              std::size_t n, std::int16_t* sums) {
  std::int16_t table[256][kHalf];
  for (std::size_t i = 0; i < n * kOutputs; ++i) sums[i] = 0;
  for (std::size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (std::size_t half = 0; half < kOutputs; half += kHalf) {
      fill_table(weights + half, table);
      for (std::size_t i = 0; i < n; ++i) {
        std::int16_t* sum = sums + i * kOutputs + half;
        std::int16_t acc[kHalf] = {};
        for (std::size_t group = 0; group < 16; ++group) {
          const std::int16_t* row = table[16 * group + (words[i] >> (4 * group) & 15)];
          for (std::size_t o = 0; o < kHalf; ++o)
            acc[o] = static_cast<std::int16_t>(acc[o] + row[o]);
        }
        for (std::size_t o = 0; o < kHalf; ++o) sum[o] = static_cast<std::int16_t>(sum[o] + acc[o]);
      }
    }
  }
}

void bit_sum(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
             std::int16_t* sums) {
  std::int16_t acc[kOutputs] = {};
  for (std::size_t i = 0; i < count; ++i) {
    const std::int8_t* row = weights + set[i] * kOutputs;
    for (std::size_t o = 0; o < kOutputs; ++o) acc[o] = static_cast<std::int16_t>(acc[o] + row[o]);
  }
  for (std::size_t o = 0; o < kOutputs; ++o) sums[o] = acc[o];
}

void dense(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
           std::size_t stride, std::size_t n, std::size_t outputs, std::int32_t* sums) {
  for (std::size_t i = 0; i < n; ++i, x += stride, sums += kOutputs) {
    const std::int8_t* w = weights;
    for (std::size_t group = 0; group < outputs; group += 16) {
      std::int32_t acc[16] = {};
      for (std::size_t j = 0; j < inputs; j += 4, w += 4 * 16) {
        for (std::size_t o = 0; o < 16; ++o) {
          acc[o] += w[4 * o] * x[j] + w[4 * o + 1] * x[j + 1] + w[4 * o + 2] * x[j + 2] +
                    w[4 * o + 3] * x[j + 3];
        }
      }
      for (std::size_t o = 0; o < 16; ++o) sums[group + o] = acc[o];
    }
  }
}

// Rounds half up. s * multiplier is below 2^62, so adding 2^61 at most cannot overflow.
template <typename Sum>
void activate(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
              std::size_t stride) {
  const std::int64_t half = std::int64_t{1} << (a.shift - 1);
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    for (std::size_t o = 0; o < kOutputs; ++o) {
      const std::int64_t s = std::int64_t{sums[o]} + a.bias[o];
      const std::int64_t t = (s * a.multipliers[o] + half) >> a.shift;
      next[o] = a.table[t < -128 ? 0 : t > 127 ? 255 : t + 128];
    }
  }
}

// Queries come as q + 128: |p|^2 - 2 p . q = |p|^2 + 256 sum(p) - 2 p . (q + 128).
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim, std::size_t,
                 std::int32_t* biases, std::int32_t*) {
  for (std::size_t b = 0; b < blocks; ++b, packed += kCodeRows * dim) {
    for (std::size_t r = 0; r < kCodeRows; ++r) {
      std::int32_t sum = 0;
      for (std::size_t d = 0; d < dim; d += 4) {
        for (std::size_t j = 0; j < 4; ++j) {
          const std::int32_t p = packed[d * kCodeRows + 4 * r + j];
          sum += p * p + 256 * p;
        }
      }
      biases[b * kCodeRows + r] = sum;
    }
  }
}

void code_unpack4(const std::uint8_t* packed, std::size_t blocks, std::size_t dim, int half_step,
                  std::int8_t* codes) {
  std::int8_t levels[16];
  for (int u = 0; u < 16; ++u) levels[u] = static_cast<std::int8_t>(half_step * (2 * u - 15));
  for (std::size_t b = 0; b < blocks; ++b) {
    for (std::size_t d = 0; d < dim; d += 4, codes += 4 * kCodeRows) {
      const int shift = d % 8 == 0 ? 0 : 4;
      for (std::size_t i = 0; i < 4 * kCodeRows; ++i) {
        codes[i] = d + i % 4 < dim ? levels[packed[i] >> shift & 15] : std::int8_t{0};
      }
      // Both halves of the bytes were read, or there is no second half.
      if (shift == 4 || d + 4 >= dim) packed += 4 * kCodeRows;
    }
  }
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  const std::size_t dim = rows.dim;
  BlockBiases biases_of(rows, code_biases);
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
    const std::int32_t* biases = biases_of(row);
    for (std::size_t q = 0; q < queries.n; ++q) {
      const std::uint8_t* query = queries.codes + q * dim;
      const std::int8_t* p = rows.codes + row * dim;
      std::int32_t dot[kCodeRows] = {};
      for (std::size_t d = 0; d < dim; d += 4, p += 4 * kCodeRows) {
        for (std::size_t r = 0; r < kCodeRows; ++r) {
          dot[r] += p[4 * r] * query[d] + p[4 * r + 1] * query[d + 1] +
                    p[4 * r + 2] * query[d + 2] + p[4 * r + 3] * query[d + 3];
        }
      }
      for (std::size_t r = 0; r < kCodeRows; ++r) {
        const std::int32_t distance = biases[r] - 2 * dot[r];
        if (distance <= queries.limits[q]) {
          hits[found++] = {static_cast<std::uint32_t>(q), static_cast<std::uint32_t>(row + r),
                           distance};
        }
      }
    }
  }
  return found;
}

// Compilers turn this form into vector code where std::popcount without -mpopcnt is a library call.
std::uint64_t popcount(std::uint64_t x) {
  x -= (x >> 1) & 0x5555555555555555u;
  x = (x & 0x3333333333333333u) + ((x >> 2) & 0x3333333333333333u);
  x = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0fu;
  x += x >> 8;
  x += x >> 16;
  x += x >> 32;
  return x & 0xff;
}

std::size_t hamming_scan(const WordQueries& queries, const PackedWords& rows, std::size_t* block,
                         Hit* hits) {
  const std::size_t words = rows.words;
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kWordRows;
    for (std::size_t q = 0; q < queries.n; ++q) {
      std::uint64_t count[kWordRows] = {};
      for (std::size_t w = 0; w < words; ++w) {
        for (std::size_t r = 0; r < kWordRows; ++r) {
          count[r] += popcount(queries.words[q * words + w] ^
                               rows.words_of_rows[row * words + w * kWordRows + r]);
        }
      }
      for (std::size_t r = 0; r < kWordRows; ++r) {
        const auto distance = static_cast<std::int32_t>(count[r]);
        if (distance <= queries.limits[q]) {
          hits[found++] = {static_cast<std::uint32_t>(q), static_cast<std::uint32_t>(row + r),
                           distance};
        }
      }
    }
  }
  return found;
}

}  // namespace

const Kernels portable = {.name = "portable",
                          .bit_sums = bit_sums,
                          .bit_sum = bit_sum,
                          .dense = dense,
                          .activate16 = activate<std::int16_t>,
                          .activate32 = activate<std::int32_t>,
                          .code_biases = code_biases,
                          .code_unpack4 = code_unpack4,
                          .code_scan = code_scan,
                          .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
