// The tile instructions of AMX. Not the compiler's intrinsics: GCC's do not say that a load reads
// memory. Tile numbers are literals; a test replaces this file by an emulation.
#pragma once

#define TILE_CONFIGURE(config) __asm__ volatile("ldtilecfg %0" : : "m"(config))
#define TILE_RELEASE() __asm__ volatile("tilerelease")
#define TILE_LOAD(tile, base, stride)                          \
  __asm__ volatile("tileloadd (%0,%1,1), %%tmm" #tile          \
                   :                                           \
                   : "r"(base), "r"(static_cast<long>(stride)) \
                   : "memory")
#define TILE_STORE(tile, base, stride)                         \
  __asm__ volatile("tilestored %%tmm" #tile ", (%0,%1,1)"      \
                   :                                           \
                   : "r"(base), "r"(static_cast<long>(stride)) \
                   : "memory")
// sums += a (unsigned bytes) x b (signed bytes)
#define TILE_DPBUSD(sums, a, b) \
  __asm__ volatile("tdpbusd %%tmm" #b ", %%tmm" #a ", %%tmm" #sums : :)
