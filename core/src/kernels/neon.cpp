// NEON with dot products (ARMv8.2 and later): phones since 2018, Apple silicon, Graviton 2.
#include <arm_neon.h>

#include "kernels.h"

namespace protomark::kernels {
namespace {

// |p|^2: queries are made signed again.
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                 std::int32_t* biases) {
  for (std::size_t b = 0; b < blocks; ++b, packed += kCodeRows * dim) {
    for (std::size_t part = 0; part < 4; ++part) {
      int32x4_t sum = vdupq_n_s32(0);
      for (std::size_t d = 0; d < dim; d += 4) {
        const int8x16_t p = vld1q_s8(packed + d * kCodeRows + 16 * part);
        sum = vdotq_s32(sum, p, p);
      }
      vst1q_s32(biases + b * kCodeRows + 4 * part, sum);
    }
  }
}

template <int Queries>
std::size_t scan_tile(const std::int8_t* queries, const std::int32_t* limits,
                      const PackedCodes& rows, std::size_t first_query, std::size_t first_row,
                      Hit* hits) {
  int32x4_t acc[Queries][4];
  for (int q = 0; q < Queries; ++q) {
    for (int part = 0; part < 4; ++part) acc[q][part] = vdupq_n_s32(0);
  }
  const std::int8_t* p = rows.codes + first_row * rows.dim;
  for (std::size_t d = 0; d < rows.dim; d += 4, p += 4 * kCodeRows) {
    const int8x16_t codes[4] = {vld1q_s8(p), vld1q_s8(p + 16), vld1q_s8(p + 32), vld1q_s8(p + 48)};
    for (int q = 0; q < Queries; ++q) {
      std::int32_t bytes;
      __builtin_memcpy(&bytes, queries + q * rows.dim + d, 4);
      const int8x16_t query = vreinterpretq_s8_s32(vdupq_n_s32(bytes));
      for (int part = 0; part < 4; ++part) {
        acc[q][part] = vdotq_s32(acc[q][part], codes[part], query);
      }
    }
  }
  uint32x4_t any = vdupq_n_u32(0);
  for (int q = 0; q < Queries; ++q) {
    const int32x4_t limit = vdupq_n_s32(limits[q]);
    for (int part = 0; part < 4; ++part) {
      const int32x4_t bias = vld1q_s32(rows.biases + first_row + 4 * part);
      acc[q][part] = vmlsq_n_s32(bias, acc[q][part], 2);
      any = vorrq_u32(any, vcleq_s32(acc[q][part], limit));
    }
  }
  if (vmaxvq_u32(any) == 0) [[likely]]
    return 0;

  std::size_t found = 0;
  for (int q = 0; q < Queries; ++q) {
    std::int32_t distances[kCodeRows];
    for (int part = 0; part < 4; ++part) vst1q_s32(distances + 4 * part, acc[q][part]);
    for (std::size_t r = 0; r < kCodeRows; ++r) {
      if (distances[r] > limits[q]) continue;
      hits[found++] = {static_cast<std::uint32_t>(first_query + q),
                       static_cast<std::uint32_t>(first_row + r), distances[r]};
    }
  }
  return found;
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  constexpr std::size_t kTile = 4;
  std::int8_t codes[kScanQueries * 256];
  for (std::size_t i = 0; i < queries.n * rows.dim; ++i) {
    codes[i] = static_cast<std::int8_t>(queries.codes[i] - 128);
  }
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
    std::size_t q = 0;
    for (; q + kTile <= queries.n; q += kTile) {
      found +=
          scan_tile<kTile>(codes + q * rows.dim, queries.limits + q, rows, q, row, hits + found);
    }
    for (; q < queries.n; ++q) {
      found += scan_tile<1>(codes + q * rows.dim, queries.limits + q, rows, q, row, hits + found);
    }
  }
  return found;
}

template <int Queries>
std::size_t hamming_tile(const std::uint64_t* queries, const std::int32_t* limits,
                         const PackedWords& rows, std::size_t first_query, std::size_t first_row,
                         Hit* hits) {
  constexpr std::size_t kByteWords = 31;  // 31 * 8 bits are counted in a byte
  const std::size_t words = rows.words;
  const std::uint64_t* packed = rows.words_of_rows + first_row * words;
  uint64x2_t count[Queries][4];
  for (int q = 0; q < Queries; ++q) {
    for (int part = 0; part < 4; ++part) count[q][part] = vdupq_n_u64(0);
  }
  for (std::size_t w = 0; w < words;) {
    uint8x16_t bytes[Queries][4];
    for (int q = 0; q < Queries; ++q) {
      for (int part = 0; part < 4; ++part) bytes[q][part] = vdupq_n_u8(0);
    }
    const std::size_t end = words - w < kByteWords ? words : w + kByteWords;
    for (; w < end; ++w, packed += kWordRows) {
      for (int q = 0; q < Queries; ++q) {
        const uint64x2_t query = vdupq_n_u64(queries[q * words + w]);
        for (int part = 0; part < 4; ++part) {
          const uint64x2_t differ = veorq_u64(query, vld1q_u64(packed + 2 * part));
          bytes[q][part] = vaddq_u8(bytes[q][part], vcntq_u8(vreinterpretq_u8_u64(differ)));
        }
      }
    }
    for (int q = 0; q < Queries; ++q) {
      for (int part = 0; part < 4; ++part) {
        const uint32x4_t sums = vpaddlq_u16(vpaddlq_u8(bytes[q][part]));
        count[q][part] = vpadalq_u32(count[q][part], sums);
      }
    }
  }
  std::size_t found = 0;
  for (int q = 0; q < Queries; ++q) {
    std::int64_t distances[kWordRows];
    uint64x2_t any = vdupq_n_u64(0);
    const int64x2_t limit = vdupq_n_s64(limits[q]);
    for (int part = 0; part < 4; ++part) {
      const int64x2_t distance = vreinterpretq_s64_u64(count[q][part]);
      any = vorrq_u64(any, vcleq_s64(distance, limit));
      vst1q_s64(distances + 2 * part, distance);
    }
    if (vmaxvq_u32(vreinterpretq_u32_u64(any)) == 0) [[likely]]
      continue;
    for (std::size_t r = 0; r < kWordRows; ++r) {
      if (distances[r] > limits[q]) continue;
      hits[found++] = {static_cast<std::uint32_t>(first_query + q),
                       static_cast<std::uint32_t>(first_row + r),
                       static_cast<std::int32_t>(distances[r])};
    }
  }
  return found;
}

std::size_t hamming_scan(const WordQueries& queries, const PackedWords& rows, std::size_t* block,
                         Hit* hits) {
  constexpr std::size_t kTile = 2;
  std::size_t found = 0;
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kWordRows;
    std::size_t q = 0;
    for (; q + kTile <= queries.n; q += kTile) {
      found += hamming_tile<kTile>(queries.words + q * rows.words, queries.limits + q, rows, q, row,
                                   hits + found);
    }
    for (; q < queries.n; ++q) {
      found += hamming_tile<1>(queries.words + q * rows.words, queries.limits + q, rows, q, row,
                               hits + found);
    }
  }
  return found;
}

}  // namespace

const Kernels neon = {.name = "neon",
                      .code_biases = code_biases,
                      .code_scan = code_scan,
                      .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
