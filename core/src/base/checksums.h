// CRC-32 against damage, SHA-256 for identity.
#pragma once

#include "base/bytes.h"

namespace protomark {

// Returns the CRC-32 (IEEE 802.3, as in zlib) of bytes that follow others whose CRC-32 is `crc`.
uint32_t crc32(Bytes bytes, uint32_t crc = 0);

// Returns the SHA-256 (FIPS 180-4) as 64 lower-case hexadecimal digits.
std::string sha256(Bytes bytes);

}  // namespace protomark
