// NEON with dot products (ARMv8.2 and later): phones since 2018, Apple silicon, Graviton 2.
#include <arm_neon.h>

#include "block_biases.h"
#include "heads.h"
#include "kernels.h"

namespace protomark::kernels {
namespace {

// Outputs that are summed together: with a table of 16 KB for 64 inputs, in the L1 cache.
constexpr std::size_t kHalf = kOutputs / 2;
constexpr int kParts = kHalf / 8;  // registers of 8 sums

// The sums of all subsets of 4 inputs, for each 4 of 64 inputs.
void fill_table(const std::int8_t* weights, std::int16_t* table) {
  for (int group = 0; group < 16; ++group, weights += 4 * kOutputs, table += 16 * kHalf) {
    for (int part = 0; part < kParts; ++part) {
      const std::int8_t* w = weights + 8 * part;
      const int16x8_t a = vmovl_s8(vld1_s8(w)), b = vmovl_s8(vld1_s8(w + kOutputs));
      const int16x8_t c = vmovl_s8(vld1_s8(w + 2 * kOutputs));
      const int16x8_t d = vmovl_s8(vld1_s8(w + 3 * kOutputs));
      const int16x8_t low[4] = {vdupq_n_s16(0), a, b, vaddq_s16(a, b)};
      const int16x8_t high[4] = {vdupq_n_s16(0), c, d, vaddq_s16(c, d)};
      std::int16_t* row = table + 8 * part;
      for (const int16x8_t h : high) {
        for (const int16x8_t l : low) {
          vst1q_s16(row, vaddq_s16(h, l));
          row += kHalf;
        }
      }
    }
  }
}

void bit_sums(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
              std::size_t n, std::int16_t* sums) {
  std::int16_t table[256 * kHalf];
  for (std::size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (std::size_t half = 0; half < kOutputs; half += kHalf) {
      fill_table(weights + half, table);
      std::int16_t* sum = sums + half;
      for (std::size_t i = 0; i < n; ++i, sum += kOutputs) {
        int16x8_t acc[kParts];
        for (int p = 0; p < kParts; ++p) {
          acc[p] = w == 0 ? vdupq_n_s16(0) : vld1q_s16(sum + 8 * p);
        }
        for (int group = 0; group < 16; ++group) {
          const std::int16_t* row = table + (16 * group + (words[i] >> (4 * group) & 15)) * kHalf;
          for (int p = 0; p < kParts; ++p) acc[p] = vaddq_s16(acc[p], vld1q_s16(row + 8 * p));
        }
        for (int p = 0; p < kParts; ++p) vst1q_s16(sum + 8 * p, acc[p]);
      }
    }
  }
}

void bit_sum(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
             std::int16_t* sums) {
  int16x8_t acc[8];
  for (int16x8_t& a : acc) a = vdupq_n_s16(0);
  for (std::size_t i = 0; i < count; ++i) {
    const std::int8_t* row = weights + set[i] * kOutputs;
    for (int p = 0; p < 8; ++p) acc[p] = vaddw_s8(acc[p], vld1_s8(row + 8 * p));
  }
  for (int p = 0; p < 8; ++p) vst1q_s16(sums + 8 * p, acc[p]);
}

template <int Lane, int Batch>
void dot(int32x4_t (&acc)[Batch][4], const std::int8_t* weights, const int8x16_t* x) {
  for (int g = 0; g < 4; ++g) {
    const int8x16_t w = vld1q_s8(weights + 64 * Lane + 16 * g);
    for (int i = 0; i < Batch; ++i) acc[i][g] = vdotq_laneq_s32(acc[i][g], w, x[i], Lane);
  }
}

// `Batch` inputs share each load of 16 outputs' weights. x is taken as x - 128, which has a sign as
// the weights have; `shift` is what that takes away.
template <int Batch>
void dense_tile(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                std::size_t stride, const int32x4_t* shift, std::int32_t* sums) {
  int32x4_t acc[Batch][4];
  for (auto& row : acc) {
    for (int g = 0; g < 4; ++g) row[g] = shift[g];
  }
  for (std::size_t j = 0; j < inputs; j += 16, weights += 16 * 16) {
    int8x16_t v[Batch];
    for (int i = 0; i < Batch; ++i) {
      v[i] = vreinterpretq_s8_u8(veorq_u8(vld1q_u8(x + i * stride + j), vdupq_n_u8(128)));
    }
    dot<0>(acc, weights, v);
    dot<1>(acc, weights, v);
    dot<2>(acc, weights, v);
    dot<3>(acc, weights, v);
  }
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < 4; ++g) vst1q_s32(sums + i * kOutputs + 4 * g, acc[i][g]);
  }
}

void dense(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
           std::size_t stride, std::size_t n, std::size_t outputs, std::int32_t* sums) {
  constexpr int kBatch = 4;
  for (std::size_t o = 0; o < outputs; o += 16, weights += 16 * inputs, sums += 16) {
    int32x4_t shift[4];
    for (int g = 0; g < 4; ++g) {
      shift[g] = vdupq_n_s32(0);
      for (std::size_t j = 0; j < inputs; j += 4) {
        shift[g] = vdotq_s32(shift[g], vld1q_s8(weights + 16 * j + 16 * g), vdupq_n_s8(1));
      }
      shift[g] = vshlq_n_s32(shift[g], 7);
    }
    std::size_t i = 0;
    for (; i + kBatch <= n; i += kBatch) {
      dense_tile<kBatch>(weights, inputs, x + i * stride, stride, shift, sums + i * kOutputs);
    }
    for (; i < n; ++i) {
      dense_tile<1>(weights, inputs, x + i * stride, stride, shift, sums + i * kOutputs);
    }
  }
}

int32x4_t load_sums(const std::int32_t* sums) { return vld1q_s32(sums); }

int32x4_t load_sums(const std::int16_t* sums) { return vmovl_s16(vld1_s16(sums)); }

template <typename Sum>
void activate(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
              std::size_t stride) {
  uint8x16x4_t table[4];
  for (int k = 0; k < 4; ++k) table[k] = vld1q_u8_x4(a.table + 64 * k);
  const int64x2_t half = vdupq_n_s64(std::int64_t{1} << (a.shift - 1));
  const int32x4_t shift = vdupq_n_s32(32 - a.shift);
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    for (std::size_t o = 0; o < kOutputs; o += 16) {
      int16x4_t t[4];
      for (int q = 0; q < 4; ++q) {
        const std::size_t at = o + 4 * q;
        const int32x4_t s = vaddq_s32(load_sums(sums + at), vld1q_s32(a.bias + at));
        const int32x4_t m = vld1q_s32(a.multipliers + at);
        const int32x2_t low = vaddhn_s64(vmull_s32(vget_low_s32(s), vget_low_s32(m)), half);
        const int32x4_t upper = vaddhn_high_s64(low, vmull_high_s32(s, m), half);
        t[q] = vqmovn_s32(vshlq_s32(upper, shift));
      }
      const int8x16_t packed =
          vqmovn_high_s16(vqmovn_s16(vcombine_s16(t[0], t[1])), vcombine_s16(t[2], t[3]));
      // Indices out of range leave a byte as it is.
      uint8x16_t index = veorq_u8(vreinterpretq_u8_s8(packed), vdupq_n_u8(128));
      uint8x16_t bytes = vqtbl4q_u8(table[0], index);
      for (int k = 1; k < 4; ++k) {
        index = vsubq_u8(index, vdupq_n_u8(64));
        bytes = vqtbx4q_u8(bytes, table[k], index);
      }
      vst1q_u8(next + o, bytes);
    }
  }
}

// |p|^2: queries are made signed again.
void code_biases(const std::int8_t* packed, std::size_t blocks, std::size_t dim, std::size_t head,
                 std::int32_t* biases, std::int32_t* head_biases) {
  for (std::size_t b = 0; b < blocks; ++b, packed += kCodeRows * dim) {
    for (std::size_t part = 0; part < 4; ++part) {
      int32x4_t sum = vdupq_n_s32(0);
      for (std::size_t d = 0; d < dim; d += 4) {
        if (d == head) vst1q_s32(head_biases + b * kCodeRows + 4 * part, sum);
        const int8x16_t p = vld1q_s8(packed + d * kCodeRows + 16 * part);
        sum = vdotq_s32(sum, p, p);
      }
      vst1q_s32(biases + b * kCodeRows + 4 * part, sum);
    }
  }
}

// Distances over the first `dims` dimensions, whose biases in a block are given. Inlined, so that
// they stay in registers.
template <int Queries>
[[gnu::always_inline]] inline void sum_up(const std::int8_t* queries, const PackedCodes& rows,
                                          std::size_t first_row, const std::int32_t* biases,
                                          std::size_t dims, int32x4_t (&acc)[Queries][4]) {
  for (int q = 0; q < Queries; ++q) {
    for (int part = 0; part < 4; ++part) acc[q][part] = vdupq_n_s32(0);
  }
  const std::int8_t* p = rows.codes + first_row * rows.dim;
  for (std::size_t d = 0; d < dims; d += 4, p += 4 * kCodeRows) {
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
  for (int q = 0; q < Queries; ++q) {
    for (int part = 0; part < 4; ++part) {
      const int32x4_t bias = vld1q_s32(biases + 4 * part);
      acc[q][part] = vmlsq_n_s32(bias, acc[q][part], 2);
    }
  }
}

// Bits are set where a distance is within the limit.
uint32x4_t within(const int32x4_t (&distances)[4], std::int32_t limit) {
  const int32x4_t most = vdupq_n_s32(limit);
  uint32x4_t any = vdupq_n_u32(0);
  for (const int32x4_t part : distances) any = vorrq_u32(any, vcleq_s32(part, most));
  return any;
}

template <int Queries>
std::size_t scan_tile(const std::int8_t* queries, const std::int32_t* limits,
                      const PackedCodes& rows, const std::int32_t* biases, std::size_t first_query,
                      std::size_t first_row, Hit* hits) {
  int32x4_t acc[Queries][4];
  sum_up(queries, rows, first_row, biases, rows.dim, acc);
  uint32x4_t any = vdupq_n_u32(0);
  for (int q = 0; q < Queries; ++q) any = vorrq_u32(any, within(acc[q], limits[q]));
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

// Appends to `found` which queries from `first_query` on may be within their limits of a block, by
// their heads.
template <int Queries>
std::size_t near_by_heads(const std::int8_t* codes, const std::int32_t* head_limits,
                          const PackedCodes& rows, std::size_t first_query, std::size_t first_row,
                          std::uint8_t* found) {
  int32x4_t acc[Queries][4];
  sum_up(codes, rows, first_row, rows.head_biases + first_row, rows.head, acc);
  std::size_t size = 0;
  for (int q = 0; q < Queries; ++q) {
    // No branch: which ones are near cannot be foretold.
    found[size] = static_cast<std::uint8_t>(first_query + static_cast<std::size_t>(q));
    size += vmaxvq_u32(within(acc[q], head_limits[q])) != 0;
  }
  return size;
}

std::size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                      Hit* hits) {
  constexpr std::size_t kTile = 4;
  std::int8_t codes[kScanQueries * 256];
  for (std::size_t i = 0; i < queries.n * rows.dim; ++i) {
    codes[i] = static_cast<std::int8_t>(queries.codes[i] - 128);
  }
  Heads heads(queries, rows);
  std::size_t found = 0;
  BlockBiases biases_of(rows, code_biases);
  const std::int32_t* biases = nullptr;  // of the block
  const auto scan = [&]<int Queries>(std::size_t q, std::size_t row) {
    found += scan_tile<Queries>(codes + q * rows.dim, queries.limits + q, rows, biases, q, row,
                                hits + found);
  };
  for (; *block < rows.blocks && found < kHitsEnough; ++*block) {
    const std::size_t row = *block * kCodeRows;
    biases = biases_of(row);
    std::size_t q = 0;
    if (heads.now()) {
      std::uint8_t likely[kScanQueries];
      std::size_t n = 0;
      for (; q + kTile <= queries.n; q += kTile) {
        n += near_by_heads<kTile>(codes + q * rows.dim, heads.limits() + q, rows, q, row,
                                  likely + n);
      }
      heads.left(n);
      for (std::size_t i = 0; i < n; ++i) scan.template operator()<1>(likely[i], row);
    }
    for (; q + kTile <= queries.n; q += kTile) scan.template operator()<kTile>(q, row);
    for (; q < queries.n; ++q) scan.template operator()<1>(q, row);
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
                      .bit_sums = bit_sums,
                      .bit_sum = bit_sum,
                      .dense = dense,
                      .activate16 = activate<std::int16_t>,
                      .activate32 = activate<std::int32_t>,
                      .code_biases = code_biases,
                      .code_scan = code_scan,
                      .hamming_scan = hamming_scan};

}  // namespace protomark::kernels
