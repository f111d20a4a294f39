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

// A row that is near enough to a query. Both are counted from 0 within what a scan was given.
struct Hit {
  std::uint32_t query;
  std::uint32_t row;
  std::int32_t distance;
};

// Queries that a scan takes at a time, so that they share its loads.
inline constexpr std::size_t kScanQueries = 16;
// A scan stops early once it has this many hits, so that limits can follow; it may have more by
// what kScanQueries queries can hit in 64 rows.
inline constexpr std::size_t kHitsEnough = 64;
inline constexpr std::size_t kHitRoom = kHitsEnough + kScanQueries * 64;

// Codes q + 128, unsigned, n x dim; n is 1 to kScanQueries.
struct CodeQueries {
  const std::uint8_t* codes;
  const std::int32_t* limits;
  std::size_t n;
};

// Codes p, -127 to 127, in blocks of 16 rows: for every 4 dimensions, 16 rows x 4 codes. `dim` is a
// multiple of 4, 256 at most.
struct PackedCodes {
  const std::int8_t* codes;
  const std::int32_t* biases;  // from code_biases of the same set
  std::size_t blocks;
  std::size_t dim;
};

// n x words; n is 1 to kScanQueries.
struct WordQueries {
  const std::uint64_t* words;
  const std::int32_t* limits;
  std::size_t n;
};

// Bits in blocks of 8 rows: for every 64-bit word, the word of 8 rows.
struct PackedWords {
  const std::uint64_t* words_of_rows;
  std::size_t blocks;
  std::size_t words;
};

struct Kernels {
  const char* name = nullptr;

  // sums[i * outputs + o] = bias[o] + sum_j weights[o][j] * inputs[i * layer.inputs + j] for n
  // inputs and the first `outputs` outputs (a multiple of 16).
  void (*dense)(const PackedLayer& layer, const std::uint8_t* inputs, std::size_t n,
                std::size_t outputs, std::int32_t* sums) = nullptr;

  // What code_scan of the same set starts from, a number a row.
  void (*code_biases)(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                      std::int32_t* biases) = nullptr;

  // 4-bit numbers u as codes half_step * (2 u - 15), packed as code_scan takes them, `dim` rounded
  // up to a multiple of 4 with zeros, whatever `packed` holds there. They are packed in blocks of
  // 16 rows: for every 8 dimensions, 16 rows x 4 bytes; byte j holds dimension j in its low four
  // bits, 4 + j in its high ones. `half_step` is 1 to 8.
  void (*code_unpack4)(const std::uint8_t* packed, std::size_t blocks, std::size_t dim,
                       int half_step, std::int8_t* codes) = nullptr;

  // Finds all rows with |p|^2 - 2 p . q <= limits[q], and that value, from block *block on. Stops
  // at the end, or after a block with kHitsEnough hits; *block is then where to go on. Returns the
  // number of hits, in no order.
  std::size_t (*code_scan)(const CodeQueries& queries, const PackedCodes& rows, std::size_t* block,
                           Hit* hits) = nullptr;

  // The same for rows with a Hamming distance <= limits[q].
  std::size_t (*hamming_scan)(const WordQueries& queries, const PackedWords& rows,
                              std::size_t* block, Hit* hits) = nullptr;
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
extern const Kernels amx;
#elif defined(__aarch64__)
extern const Kernels neon;
#endif

}  // namespace protomark::kernels
