// The tile instructions that kernels/amx.cpp uses, in plain C++ after the pseudo-code of Intel's
// Software Developer's Manual, volume 2 (LDTILECFG, TILELOADD, TILESTORED, TDPBUSD, TILERELEASE).
// What raises #GP or #UD there, aborts here.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>

namespace protomark::test {

class Tiles {
 public:
  void configure(const void* config) {
    const auto* bytes = static_cast<const std::uint8_t*>(config);
    require(bytes[0] == 1 && bytes[1] == 0);
    for (int i = 2; i < 16; ++i) require(bytes[i] == 0);
    for (int i = 32; i < 48; ++i) require(bytes[i] == 0);
    for (int i = 56; i < 64; ++i) require(bytes[i] == 0);
    for (int tile = 0; tile < 8; ++tile) {
      rows_[tile] = bytes[48 + tile];
      std::memcpy(&row_bytes_[tile], bytes + 16 + 2 * tile, 2);
      require(rows_[tile] <= 16 && row_bytes_[tile] <= 64);
      require((rows_[tile] == 0) == (row_bytes_[tile] == 0));
    }
    std::memset(data_, 0, sizeof data_);
    configured_ = true;
  }

  void release() { configured_ = false; }

  void load(int tile, const void* base, std::ptrdiff_t stride) {
    require_valid(tile);
    std::memset(data_[tile], 0, sizeof data_[tile]);
    for (int row = 0; row < rows_[tile]; ++row) {
      std::memcpy(data_[tile][row], static_cast<const char*>(base) + row * stride,
                  row_bytes_[tile]);
    }
  }

  void store(int tile, void* base, std::ptrdiff_t stride) const {
    require_valid(tile);
    for (int row = 0; row < rows_[tile]; ++row) {
      std::memcpy(static_cast<char*>(base) + row * stride, data_[tile][row], row_bytes_[tile]);
    }
  }

  void dpbusd(int sums, int a, int b) {
    require_valid(sums), require_valid(a), require_valid(b);
    require(sums != a && sums != b && a != b);
    require(row_bytes_[a] % 4 == 0 && row_bytes_[b] % 4 == 0 && row_bytes_[sums] % 4 == 0);
    require(rows_[sums] == rows_[a]);
    require(row_bytes_[sums] == row_bytes_[b]);
    require(row_bytes_[a] / 4 == rows_[b]);
    for (int m = 0; m < rows_[sums]; ++m) {
      for (int k = 0; k < row_bytes_[a] / 4; ++k) {
        for (int n = 0; n < row_bytes_[sums] / 4; ++n) {
          std::int32_t sum;
          std::memcpy(&sum, &data_[sums][m][4 * n], 4);
          for (int i = 0; i < 4; ++i) {
            sum += data_[a][m][4 * k + i] * static_cast<std::int8_t>(data_[b][k][4 * n + i]);
          }
          std::memcpy(&data_[sums][m][4 * n], &sum, 4);
        }
      }
    }
  }

  bool configured() const { return configured_; }

 private:
  static void require(bool ok) {
    if (!ok) std::abort();
  }
  void require_valid(int tile) const {
    require(configured_ && tile >= 0 && tile < 8 && rows_[tile] != 0);
  }

  bool configured_ = false;
  int rows_[8] = {};
  std::uint16_t row_bytes_[8] = {};
  std::uint8_t data_[8][16][64] = {};
};

inline thread_local Tiles tiles;

}  // namespace protomark::test

#define TILE_CONFIGURE(config) protomark::test::tiles.configure(&(config))
#define TILE_RELEASE() protomark::test::tiles.release()
#define TILE_LOAD(tile, base, stride) \
  protomark::test::tiles.load(tile, base, static_cast<std::ptrdiff_t>(stride))
#define TILE_STORE(tile, base, stride) \
  protomark::test::tiles.store(tile, base, static_cast<std::ptrdiff_t>(stride))
#define TILE_DPBUSD(sums, a, b) protomark::test::tiles.dpbusd(sums, a, b)
