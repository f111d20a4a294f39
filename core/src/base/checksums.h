// Checksums of files: CRC-32 against damage, SHA-256 for identity.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

namespace protomark {

// The CRC-32 of zlib, PNG and Ethernet (IEEE 802.3), so that any language can check a file.
// Continues `crc`, 0 at the start, over more bytes.
std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t crc = 0);

// The SHA-256 (FIPS 180-4), as 64 lower-case hexadecimal digits.
std::string sha256(std::span<const std::byte> bytes);

}  // namespace protomark
