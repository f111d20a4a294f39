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

// A row that is near enough to a query. Both are counted from 0 within what a scan was given.
struct Hit {
  std::uint32_t query;
  std::uint32_t row;
  std::int32_t distance;
};

// Queries that a scan takes at a time, so that they share its loads.
inline constexpr std::size_t kScanQueries = 16;
// So few queries need no biases: a set finds them as it compares.
inline constexpr std::size_t kFewQueries = 4;
// A scan stops early once it has this many hits, so that limits can follow; it may have more by
// what kScanQueries queries can hit in 64 rows.
inline constexpr std::size_t kHitsEnough = 64;
inline constexpr std::size_t kHitRoom = kHitsEnough + kScanQueries * 64;

// Codes q + 128, unsigned, n x dim; n is 1 to kScanQueries.
struct CodeQueries {
  const std::uint8_t* codes;
  const std::int32_t* limits;
  const std::int32_t* tails;  // squared norm of each without its head
  std::size_t n;
  std::size_t* put_off;  // what scans learn of heads, for later scans; 0 at first
};

// Codes p, -127 to 127, in blocks of 16 rows: for every 4 dimensions, 16 rows x 4 codes. `dim` is a
// multiple of 4, 256 at most. `head`, a multiple of 4 up to dim, says of how many dimensions the
// distance is likely to show that a row is too far away; a set may make use of it. Where it is dim,
// head_biases are neither written nor read.
struct PackedCodes {
  const std::int8_t* codes;
  const std::int32_t* biases;  // from code_biases of the same set; up to kFewQueries may lack them
  const std::int32_t* head_biases;
  std::size_t blocks;
  std::size_t dim;
  std::size_t head;
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

  // What code_scan of the same set starts from, a number a row for all dimensions and one for the
  // first `head`, where the set makes use of it.
  void (*code_biases)(const std::int8_t* packed, std::size_t blocks, std::size_t dim,
                      std::size_t head, std::int32_t* biases, std::int32_t* head_biases) = nullptr;

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
