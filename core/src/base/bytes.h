// Plain values at any address, and checksums of bytes.
#pragma once

#include <cstring>

#include "protomark/types.h"

namespace protomark {

using Bytes = std::span<const std::byte>;

template <typename T>
T load(const void* from) {
  T value;
  std::memcpy(&value, from, sizeof(value));
  return value;
}
void store(void* to, const auto& value) { std::memcpy(to, &value, sizeof(value)); }

// Returns the CRC-32 (IEEE 802.3, as in zlib) of bytes that follow others whose CRC-32 is `crc`.
uint32_t crc32(Bytes bytes, uint32_t crc = 0);

// Returns the SHA-256 (FIPS 180-4) as 64 lower-case hexadecimal digits.
std::string sha256(Bytes bytes);

}  // namespace protomark
