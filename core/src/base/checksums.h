// CRC-32 against damage, SHA-256 for identity.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

namespace protomark {

// Returns the CRC-32 (IEEE 802.3, as in zlib) of bytes that follow others whose CRC-32 is `crc`.
uint32_t crc32(std::span<const std::byte> bytes, uint32_t crc = 0);

// Returns the SHA-256 (FIPS 180-4) as 64 lower-case hexadecimal digits.
std::string sha256(std::span<const std::byte> bytes);

}  // namespace protomark
