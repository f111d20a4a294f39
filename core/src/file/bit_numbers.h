// Numbers of 1 to 32 bits, one after the other, least significant bits first.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace protomark {

// With 7 bytes of zero behind them, so that each is read at once.
constexpr std::size_t bit_numbers_size(std::size_t n, int bits) {
  return n / 8 * static_cast<std::size_t>(bits) + (n % 8 * static_cast<std::size_t>(bits) + 7) / 8 +
         7;
}

inline std::uint32_t bit_number(const std::uint8_t* numbers, int bits, std::size_t i) {
  const std::size_t first = i % 8 * static_cast<std::size_t>(bits);
  std::uint64_t word;
  std::memcpy(&word, numbers + i / 8 * static_cast<std::size_t>(bits) + first / 8, sizeof word);
  return static_cast<std::uint32_t>(word >> first % 8 & ((std::uint64_t{1} << bits) - 1));
}

inline std::vector<std::uint8_t> pack_bit_numbers(const std::vector<std::uint32_t>& numbers,
                                                  int bits) {
  std::vector<std::uint8_t> result(bit_numbers_size(numbers.size(), bits), 0);
  for (std::size_t i = 0; i < numbers.size(); ++i) {
    const std::size_t first = i % 8 * static_cast<std::size_t>(bits);
    std::uint8_t* at = result.data() + i / 8 * static_cast<std::size_t>(bits) + first / 8;
    std::uint64_t word;
    std::memcpy(&word, at, sizeof word);
    word |= std::uint64_t{numbers[i]} << first % 8;
    std::memcpy(at, &word, sizeof word);
  }
  return result;
}

}  // namespace protomark
