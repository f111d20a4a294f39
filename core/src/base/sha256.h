// SHA-256 (FIPS 180-4), the identity of an encoder.
#pragma once

#include <cstddef>
#include <span>
#include <string>

namespace protomark {

// 64 lower-case hexadecimal digits.
std::string sha256(std::span<const std::byte> bytes);

}  // namespace protomark
