// Plain C++, for every machine; the definition that the others must match.
#include "kernels.h"

namespace protomark::kernels {
namespace {

void dense(const PackedLayer& layer, const std::uint8_t* inputs, std::size_t n, std::size_t outputs,
           std::int32_t* sums) {
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint8_t* x = inputs + i * layer.inputs;
    for (std::size_t group = 0; group < outputs; group += kCodeRows) {
      std::int32_t acc[kCodeRows];
      for (std::size_t o = 0; o < kCodeRows; ++o) acc[o] = layer.bias[group + o];
      const std::int8_t* w = layer.weights + group * layer.inputs;
      for (std::size_t j = 0; j < layer.inputs; j += 4, w += 4 * kCodeRows) {
        for (std::size_t o = 0; o < kCodeRows; ++o) {
          acc[o] += w[4 * o] * x[j] + w[4 * o + 1] * x[j + 1] + w[4 * o + 2] * x[j + 2] +
                    w[4 * o + 3] * x[j + 3];
        }
      }
      for (std::size_t o = 0; o < kCodeRows; ++o) sums[i * outputs + group + o] = acc[o];
    }
  }
}

// Queries come as q + 128: |p|^2 - 2 p . q = |p|^2 + 256 sum(p) - 2 p . (q + 128).
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                 std::int32_t* biases) {
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
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
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
        const std::int32_t distance = rows.biases[row + r] - 2 * dot[r];
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
                          .dense = dense,
                          .code_biases = code_biases,
                          .code_unpack4 = code_unpack4,
                          .code_scan = code_scan,
                          .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
