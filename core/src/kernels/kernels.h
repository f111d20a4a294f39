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

// One fully connected layer. Weights are packed for 4-way dot products: group g holds the outputs
// 16 g to 16 g + 15; within it, for every 4 inputs, 16 outputs x 4 weights. Both are padded with
// zeros: `inputs` is a multiple of 4, `outputs` one of 16.
struct PackedLayer {
  const std::int8_t* weights;
  const std::int32_t* bias;
  std::size_t inputs;
  std::size_t outputs;
};

struct Hits {
  std::uint32_t* rows;
  std::int32_t* distances;
};

struct Kernels {
  const char* name = nullptr;

  // sums[i * outputs + o] = bias[o] + sum_j weights[o][j] * inputs[i * layer.inputs + j] for n
  // inputs and the first `outputs` outputs (a multiple of 16).
  void (*dense)(const PackedLayer& layer, const std::uint8_t* inputs, std::size_t n,
                std::size_t outputs, std::int32_t* sums) = nullptr;

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
