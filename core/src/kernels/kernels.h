// The inner loops, one set for each instruction set; all sets give the same bytes. A set leaves out
// (nullptr) what it does no better than the set below it, down to plain C++, which has all.
//
// Only plain types here, and no function with a body: a kernel file is compiled with flags of its
// own, and whatever it instantiated could be picked by the linker for a CPU that lacks them.
#pragma once

#include <cstddef>
#include <cstdint>

namespace protomark::kernels {

// Rows in a block share a vector register: 16 rows of 32-bit results, 8 rows of 64-bit words.
inline constexpr std::size_t kCodeRows = 16;
inline constexpr std::size_t kWordRows = 8;

// The encoder works on blocks of 64 outputs; numbers of outputs are padded to whole blocks.
inline constexpr std::size_t kOutputs = 64;

// What follows the sums of 64 outputs: with s = sum + bias[o],
//   next = table[clamp((s * multipliers[o] + 2^(shift - 1)) >> shift, -128, 127) + 128].
// s is within 32 bits, multipliers are positive.
struct Activation {
  const std::int32_t* bias;
  const std::int32_t* multipliers;
  const std::uint8_t* table;
  int shift;
};

struct Hits {
  std::uint32_t* rows;
  std::int32_t* distances;
};

struct Kernels {
  const char* name = nullptr;

  // Inputs that are bits: sums[i * 64 + o] is the sum of weights[j * 64 + o] over the bits j that
  // are set in descriptor i, for 64 outputs and n descriptors. Bit j % 64 of words[j / 64 * n + i]
  // is bit j of descriptor i; there are `count` words a descriptor. No sum may leave 16 bits.
  void (*bit_sums)(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
                   std::size_t n, std::int16_t* sums) = nullptr;

  // The same for a single descriptor, of which the `count` bits in `set` are set.
  void (*bit_sum)(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
                  std::int16_t* sums) = nullptr;

  // Inputs that are bytes: sums[i * 64 + o] = sum_j weights[o][j] * x[i * stride + j] for n inputs
  // and the first `outputs` of 64 outputs, a multiple of 16. Weights are packed for 4-way dot
  // products: for every 16 outputs, for every 4 inputs, 16 outputs x 4 weights. `inputs` is a
  // multiple of 64.
  void (*dense)(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                std::size_t stride, std::size_t n, std::size_t outputs,
                std::int32_t* sums) = nullptr;

  // 64 sums of n inputs to next[i * stride + o]. Sets other than portable take only shifts of 32
  // and more, where a 64-bit product's upper half is enough.
  void (*activate16)(const Activation& activation, const std::int16_t* sums, std::size_t n,
                     std::uint8_t* next, std::size_t stride) = nullptr;
  void (*activate32)(const Activation& activation, const std::int32_t* sums, std::size_t n,
                     std::uint8_t* next, std::size_t stride) = nullptr;

  // Codes are packed in blocks of 16 rows: for every 4 dimensions, 16 rows x 4 codes. `dim` is a
  // multiple of 4, `blocks` counts blocks. offsets[row] = |p|^2 + 256 sum(p), what code_scan adds
  // to a product so that it becomes a squared distance.
  void (*code_offsets)(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                       std::int32_t* offsets) = nullptr;

  // 4-bit numbers u as codes half_step * (2 u - 15), packed as code_scan takes them, `dim` rounded
  // up to a multiple of 4 with zeros, whatever `packed` holds there. They are packed in blocks of
  // 16 rows: for every 8 dimensions, 16 rows x 4 bytes; byte j holds dimension j in its low four
  // bits, 4 + j in its high ones. `half_step` is 1 to 8.
  void (*code_unpack4)(const std::uint8_t* packed, std::size_t blocks, std::size_t dim,
                       int half_step, std::int8_t* codes) = nullptr;

  // All rows with offsets[row] - 2 * (q + 128) . p <= limit, in ascending order, with that value;
  // `query` is q + 128, unsigned. Returns how many were written to `hits`.
  std::size_t (*code_scan)(const std::uint8_t* query, const std::int8_t* packed, std::size_t blocks,
                           std::size_t dim, const std::int32_t* offsets, std::int32_t limit,
                           Hits hits) = nullptr;

  // Bits are packed in blocks of 8 rows: for every 64-bit word, the word of 8 rows. All rows with a
  // Hamming distance <= limit, in ascending order. Returns how many were written to `hits`.
  std::size_t (*hamming_scan)(const std::uint64_t* query, const std::uint64_t* packed,
                              std::size_t blocks, std::size_t words, std::int32_t limit,
                              Hits hits) = nullptr;
};

// The best set that this CPU runs, complete, or the one that the environment variable PROTOMARK_ISA
// names. Throws std::invalid_argument where that is unknown or does not run here.
const Kernels& active();

// The set of that name, complete, or nullptr where it is not built in or does not run on this CPU.
const Kernels* find(const char* name);

// The names of the sets that run on this CPU, best first, up to nullptr.
const char* const* names();

// The sets as their files define them, with what they leave out; use the functions above.
extern const Kernels portable;
#if defined(__x86_64__)
extern const Kernels avx2;
extern const Kernels avx512;
#elif defined(__aarch64__)
extern const Kernels neon;
#endif

}  // namespace protomark::kernels
