// SHA-256 (FIPS 180-4), which gives encoders and map files their identity.
#pragma once

#include <cstddef>
#include <span>
#include <string>

namespace protomark {

// Returns 64 lower-case hexadecimal digits.
std::string sha256(std::span<const std::byte> bytes);

}  // namespace protomark
