// AMX with int8 tiles, beside AVX-512: Sapphire Rapids and later.
#include <immintrin.h>

#include "kernels/generic_search.h"
#ifdef PROTOMARK_EMULATE_AMX
#include "emulated_tiles.h"
#else
#include "amx_tiles.h"
#endif

namespace protomark::kernels {
namespace {

struct alignas(64) TileConfig {
  uint8_t palette = 1;
  uint8_t start_row = 0;
  uint8_t reserved[14] = {};
  uint16_t row_bytes[16] = {};
  uint8_t rows[16] = {};

  void set(int tile, size_t tile_rows, size_t tile_row_bytes) {
    rows[tile] = static_cast<uint8_t>(tile_rows);
    row_bytes[tile] = static_cast<uint16_t>(tile_row_bytes);
  }
};
static_assert(sizeof(TileConfig) == 64);

constexpr size_t kTileDim = 64;  // dimensions of a full tile
// Blocks compared at a time: four independent products hide the latency of a tile product.
constexpr size_t kStep = 4;

// Packed blocks and queries are tiles as they are. Tiles 0 to 3 hold the results of four blocks, 4
// and 5 queries, 6 and 7 a block: the first of each pair 64 dimensions, the second the rest.
TileConfig configuration(size_t queries, size_t dim) {
  TileConfig config;
  for (int tile = 0; tile < 4; ++tile) config.set(tile, queries, 4 * kCodeRows);
  const size_t rest = dim % kTileDim;
  if (dim >= kTileDim) {
    config.set(4, queries, kTileDim);
    config.set(6, kTileDim / 4, 4 * kCodeRows);
  }
  if (rest != 0) {
    config.set(5, queries, rest);
    config.set(7, rest / 4, 4 * kCodeRows);
  }
  return config;
}

// Adds the products, from dimension d on, of queries (tile a) and four blocks (b) to tiles 0 to 3.
#define PROTOMARK_ADD_PRODUCTS(a, b)          \
  TILE_LOAD(a, queries.codes + d, rows.dim);  \
  TILE_LOAD(b, codes[0] + d * kCodeRows, 64); \
  TILE_DPBUSD(0, a, b);                       \
  TILE_LOAD(b, codes[1] + d * kCodeRows, 64); \
  TILE_DPBUSD(1, a, b);                       \
  TILE_LOAD(b, codes[2] + d * kCodeRows, 64); \
  TILE_DPBUSD(2, a, b);                       \
  TILE_LOAD(b, codes[3] + d * kCodeRows, 64); \
  TILE_DPBUSD(3, a, b)

// halves: blocks x queries x 16. Blocks beyond `blocks` repeat the last one.
void scan_step(const CodeQueries& queries, const PackedCodes& rows, size_t block, size_t blocks,
               int32_t (*halves)[kScanQueries][kCodeRows]) {
  alignas(64) int32_t start[kStep][kCodeRows];
  const int8_t* codes[kStep];
  for (size_t i = 0; i < kStep; ++i) {
    const size_t b = block + (i < blocks ? i : blocks - 1);
    const __m512i bias = _mm512_loadu_si512(rows.biases + b * kCodeRows);
    _mm512_store_si512(start[i], _mm512_srai_epi32(bias, 1));
    codes[i] = rows.codes + b * kCodeRows * rows.dim;
  }
  // A stride of 0: all queries start alike.
  TILE_LOAD(0, start[0], 0);
  TILE_LOAD(1, start[1], 0);
  TILE_LOAD(2, start[2], 0);
  TILE_LOAD(3, start[3], 0);
  size_t d = 0;
  for (; d + kTileDim <= rows.dim; d += kTileDim) {
    PROTOMARK_ADD_PRODUCTS(4, 6);
  }
  if (d < rows.dim) {
    PROTOMARK_ADD_PRODUCTS(5, 7);
  }
  TILE_STORE(0, halves[0], 64);
  TILE_STORE(1, halves[1], 64);
  TILE_STORE(2, halves[2], 64);
  TILE_STORE(3, halves[3], 64);
}

size_t code_scan(const CodeQueries& queries, const PackedCodes& rows, size_t* block, Hit* hits) {
  // Few queries fill no tiles.
  if (rows.biases == nullptr) return avx512.code_scan(queries, rows, block, hits);
  const TileConfig config = configuration(queries.n, rows.dim);
  TILE_CONFIGURE(config);
  size_t found = 0;
  while (*block < rows.blocks && found < kHitsEnough) {
    const size_t left = rows.blocks - *block;
    const size_t blocks = left < kStep ? left : kStep;
    alignas(64) int32_t halves[kStep][kScanQueries][kCodeRows];
    scan_step(queries, rows, *block, blocks, halves);
    for (size_t q = 0; q < queries.n; ++q) {
      __m512i best = _mm512_load_si512(halves[0][q]);
      for (size_t i = 1; i < kStep; ++i) {
        best = _mm512_max_epi32(best, _mm512_load_si512(halves[i][q]));
      }
      const __m512i least = _mm512_set1_epi32(threshold(queries.limits[q]));
      if (_mm512_cmpgt_epi32_mask(best, least) == 0) continue;
      for (size_t i = 0; i < blocks; ++i) {
        const size_t row = (*block + i) * kCodeRows;
        found +=
            append_hits(_mm512_cmpgt_epi32_mask(_mm512_load_si512(halves[i][q]), least),
                        halves[i][q], rows.biases + row, queries.limits[q], q, row, hits + found);
      }
    }
    *block += blocks;
  }
  TILE_RELEASE();
  return found;
}

}  // namespace

const Kernels amx = {.name = "amx", .code_scan = code_scan};

}  // namespace protomark::kernels
