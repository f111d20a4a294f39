// Sums of codes as learning maps and commits store them: a row of n codes takes 8 + ceil(log2 n)
// bits per number, two's complement, least significant bits first, and begins at a whole byte.
#pragma once

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "file/disk.h"

namespace protomark {

// Of a row: its first numbers, as codes have at most 256.
using Sum = std::array<std::int16_t, 256>;

// Bits per number; no sum of n codes is beyond 127 n. n is 1 to 255.
constexpr unsigned sum_bits(int n) {
  return 8 + static_cast<unsigned>(std::bit_width(static_cast<unsigned>(n - 1)));
}
// Bytes per row.
constexpr std::size_t packed_sum_size(int n, std::size_t dim) {
  return (dim * sum_bits(n) + 7) / 8;
}

inline void pack_sum(const std::int16_t* sum, int n, std::size_t dim, std::byte* to) {
  const unsigned bits = sum_bits(n);
  const std::uint64_t mask = (std::uint64_t{1} << bits) - 1;
  std::uint64_t word = 0;
  unsigned filled = 0;
  for (std::size_t d = 0; d < dim; ++d) {
    word |= (static_cast<std::uint64_t>(sum[d]) & mask) << filled;
    for (filled += bits; filled >= 8; filled -= 8, word >>= 8) *to++ = static_cast<std::byte>(word);
  }
  if (filled > 0) *to = static_cast<std::byte>(word);
}

inline Sum unpack_sum(Bytes packed, int n, std::size_t dim) {
  const unsigned bits = sum_bits(n);
  std::array<std::byte, sizeof(Sum) + sizeof(std::uint32_t)> padded;
  std::memcpy(padded.data(), packed.data(), packed.size());
  Sum sum;
  for (std::size_t d = 0; d < dim; ++d) {
    std::uint32_t word;
    std::memcpy(&word, &padded[d * bits / 8], sizeof(word));
    const auto high = static_cast<std::int32_t>(word << (32 - bits - d * bits % 8));
    sum[d] = static_cast<std::int16_t>(high >> (32 - bits));
  }
  return sum;
}

}  // namespace protomark
