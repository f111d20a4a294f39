// The CRC-32 of zlib, PNG and Ethernet (IEEE 802.3), so that any language can check a file.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace protomark {

// Continues `crc` (0 at the start) over more bytes.
std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t crc = 0);

}  // namespace protomark
