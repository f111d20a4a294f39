// Hits among scan results that the AVX-512 and AMX kernels share. Of internal linkage: each of them
// is compiled with flags of its own.
#pragma once

#include <immintrin.h>

#include "kernels.h"

namespace protomark::kernels {
namespace {

// A negated distance is 2 p . (q + 128) + bias. Products are summed up from half the bias, rounded
// down, and so end at half the negated distance, rounded down: what is not below half the negated
// limit may be a hit, and the bias has the bit that was lost.
inline std::int32_t threshold(std::int32_t limit) { return -((limit >> 1) + (limit & 1)); }

// Hits of one query in a block, whose 16 halved negated distances these are.
inline std::size_t collect_hits(const std::int32_t* halves, const std::int32_t* biases,
                                std::int32_t limit, std::size_t query, std::size_t first_row,
                                Hit* hits) {
  std::size_t found = 0;
  unsigned left =
      _mm512_cmpge_epi32_mask(_mm512_loadu_si512(halves), _mm512_set1_epi32(threshold(limit)));
  for (; left != 0; left &= left - 1) {
    const auto r = static_cast<std::size_t>(__builtin_ctz(left));
    const std::int32_t distance = -2 * halves[r] - (biases[r] & 1);
    if (distance > limit) continue;
    hits[found++] = {static_cast<std::uint32_t>(query), static_cast<std::uint32_t>(first_row + r),
                     distance};
  }
  return found;
}

}  // namespace
}  // namespace protomark::kernels
