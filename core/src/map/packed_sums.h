// Sums of codes as learning maps and commits store them: a row of n codes takes 8 + ceil(log2 n)
// bits per number, two's complement, least significant bits first, and begins at a whole byte.
#pragma once

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "base/quantize.h"
#include "file/disk.h"

namespace protomark {

// Bits per number; no sum of n codes is beyond 127 n. n is 1 to 255.
constexpr unsigned sum_bits(int n) {
  return 8 + static_cast<unsigned>(std::bit_width(static_cast<unsigned>(n - 1)));
}
// Bytes per row.
constexpr std::size_t packed_sum_size(int n, std::size_t dim) {
  return (dim * sum_bits(n) + 7) / 8;
}

// Room for a row, and for what is read or written beyond it.
using PackedSum = std::array<std::byte, sizeof(Sum) + sizeof(std::uint64_t)>;

inline PackedSum pack_sum(const Sum& sum, int n, std::size_t dim) {
  const unsigned bits = sum_bits(n);
  const std::uint64_t mask = (std::uint64_t{1} << bits) - 1;
  PackedSum packed;
  std::byte* to = packed.data();
  std::uint64_t word = 0;
  unsigned filled = 0;  // bits of word
  for (std::size_t d = 0; d < dim; ++d) {
    word |= (static_cast<std::uint64_t>(sum[d]) & mask) << filled;
    filled += bits;
    if (filled < 48 && d + 1 < dim) continue;
    std::memcpy(to, &word, sizeof(word));
    to += filled / 8;
    word >>= filled / 8 * 8;
    filled %= 8;
  }
  return packed;
}

inline Sum unpack_sum(Bytes packed, int n, std::size_t dim) {
  const unsigned bits = sum_bits(n);
  PackedSum padded;
  std::memcpy(padded.data(), packed.data(), packed.size());
  Sum sum{};
  for (std::size_t d = 0; d < dim; ++d) {
    std::uint32_t word;
    std::memcpy(&word, &padded[d * bits / 8], sizeof(word));
    const auto high = static_cast<std::int32_t>(word << (32 - bits - d * bits % 8));
    sum[d] = static_cast<std::int16_t>(high >> (32 - bits));
  }
  return sum;
}

}  // namespace protomark
