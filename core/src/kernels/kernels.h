// The inner loops: a table of functions for each instruction set. All sets give the same bytes.
//
// A kernel file is compiled for one instruction set, and the linker might use a function that was
// instantiated there on a CPU without it. So this header has plain types only and no function with
// a body, and all that kernel files share (generic_*.h, vectors.h) is in anonymous namespaces.
#pragma once

#include <cstddef>
#include <cstdint>

namespace protomark::kernels {

// The rows of a block share a vector register: 16 rows of 32-bit results, 8 rows of 64-bit words.
inline constexpr size_t kCodeRows = 16;
inline constexpr size_t kWordRows = 8;

// The encoder works on blocks of 64 outputs; layers are padded to whole blocks.
inline constexpr size_t kOutputs = 64;

// What follows the sums of 64 outputs: with s = sum + bias[o], which fits 32 bits,
//   next = table[clamp((s * multipliers[o] + 2^(shift - 1)) >> shift, -128, 127) + 128].
// Multipliers are positive.
struct Activation {
  const int32_t* bias;
  const int32_t* multipliers;
  const uint8_t* table;
  int shift;
};

// A row within the limit of a query, both counted from the first of the scan.
struct Hit {
  uint32_t query;
  uint32_t row;
  int32_t distance;
};

// Queries that a scan takes at a time, so that they share its loads.
inline constexpr size_t kScanQueries = 16;
// Up to this many queries a scan computes the biases itself, which costs less than reading them.
inline constexpr size_t kFewQueries = 4;
// A scan pauses after this many hits, so that the caller can tighten the limits. Its last step may
// exceed that by what kScanQueries queries can hit in 64 rows.
inline constexpr size_t kHitsEnough = 64;
inline constexpr size_t kHitRoom = kHitsEnough + kScanQueries * 64;

// n x dim codes q as unsigned bytes q + 128; n is 1 to kScanQueries.
struct CodeQueries {
  const uint8_t* codes;
  const int32_t* limits;
  const int32_t* rest_norms;  // squared norm of each query behind the dimension prefix
  size_t n;
  size_t* steps_in_full;  // for scans to pass on to later ones; 0 at first
};

// Codes p, -127 to 127, in blocks of 16 rows: for every 4 dimensions, 16 rows x 4 codes. `dim` is a
// multiple of 4, 256 at most.
//
// `prefix`, a multiple of 4 up to dim, is the number of dimensions that usually show that a row is
// too far away; a set may compare these first. prefix_biases are not used where it equals dim.
struct PackedCodes {
  const int8_t* codes;
  const int32_t* biases;  // from code_biases of the same set; nullptr: at most kFewQueries
  const int32_t* prefix_biases;
  size_t blocks;
  size_t dim;
  size_t prefix;
};

// n x words; n is 1 to kScanQueries.
struct WordQueries {
  const uint64_t* words;
  const int32_t* limits;
  size_t n;
};

// Descriptors in blocks of 8 rows: for every 64-bit word, that word of 8 rows.
struct PackedWords {
  const uint64_t* words_of_rows;
  size_t blocks;
  size_t words;
};

struct Kernels {
  const char* name = nullptr;

  // Inputs that are bits: sums[i * 64 + o] is the sum of weights[j * 64 + o] over the bits j that
  // are set in descriptor i, for 64 outputs and n descriptors of `count` words. Bit j % 64 of
  // words[j / 64 * n + i] is bit j of descriptor i. No sum may leave 16 bits.
  void (*bit_sums)(const int8_t* weights, const uint64_t* words, size_t count, size_t n,
                   int16_t* sums) = nullptr;

  // The same for a single descriptor, of which the `count` bits in `set` are set.
  void (*bit_sum)(const int8_t* weights, const uint16_t* set, size_t count,
                  int16_t* sums) = nullptr;

  // Inputs that are bytes: sums[i * 64 + o] = sum_j weights[o][j] * x[i * stride + j] for n inputs
  // and the first `outputs` of 64 outputs, a multiple of 16. Weights are packed as prototypes are:
  // for every 16 outputs, for every 4 inputs, 16 outputs x 4 weights. `inputs` is a multiple of 64.
  void (*dense)(const int8_t* weights, size_t inputs, const uint8_t* x, size_t stride, size_t n,
                size_t outputs, int32_t* sums) = nullptr;

  // 64 sums of n inputs to next[i * stride + o]. Sets other than portable take only shifts of 32
  // and more, where the upper half of a 64-bit product is enough.
  void (*activate16)(const Activation& activation, const int16_t* sums, size_t n, uint8_t* next,
                     size_t stride) = nullptr;
  void (*activate32)(const Activation& activation, const int32_t* sums, size_t n, uint8_t* next,
                     size_t stride) = nullptr;

  // Computes the biases for code_scan of the same set, for all dimensions and for the prefix.
  void (*code_biases)(const int8_t* packed, size_t blocks, size_t dim, size_t prefix,
                      int32_t* biases, int32_t* prefix_biases) = nullptr;

  // Decodes rows of words, a byte for each `width` numbers, to codes as code_scan takes them. They
  // come in blocks of 16 rows: for every word, 16 rows. `width` divides dim. `table` has for every
  // number of a code its 256 values by word, and zeros up to a multiple of 4 numbers.
  void (*code_decode)(const uint8_t* packed, size_t blocks, size_t dim, size_t width,
                      const int8_t* table, int8_t* codes) = nullptr;

  // Finds, for each of n times 4 numbers, as unsigned bytes of numbers + 128, the nearest of 256
  // words of 4 numbers, packed as rows are, ties to the smaller. keys[w] are 256 times the biases
  // of the words, plus 255 - w.
  void (*nearest_words)(const int8_t* words, const int32_t* keys, const uint8_t* numbers, size_t n,
                        uint8_t* nearest) = nullptr;

  // Finds the rows with |p|^2 - 2 p . q <= limits[q], and that value as their distance, from block
  // *block on. Stops at the end, or after a step that reaches kHitsEnough hits, and sets *block to
  // where to continue. Returns the number of hits, which are in no order.
  size_t (*code_scan)(const CodeQueries& queries, const PackedCodes& rows, size_t* block,
                      Hit* hits) = nullptr;

  // The same for rows with a Hamming distance <= limits[q].
  size_t (*hamming_scan)(const WordQueries& queries, const PackedWords& rows, size_t* block,
                         Hit* hits) = nullptr;
};

// Returns the best set that this CPU runs, or the one that the environment variable PROTOMARK_ISA
// names. Throws std::invalid_argument if that does not run here.
const Kernels& active();

// Returns the set of that name, or nullptr if it does not run here.
const Kernels* find(const char* name);

// Returns the sets that run on this CPU, best first, up to one without a name.
const Kernels* all();

// The sets as their files define them, for the functions above. amx has only a code_scan.
extern const Kernels portable;
#if defined(__x86_64__)
extern const Kernels avx2;
extern const Kernels avx512;
extern const Kernels amx;
#elif defined(__aarch64__)
extern const Kernels neon;
#endif

}  // namespace protomark::kernels
