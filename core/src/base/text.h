// Texts: composes errors, and checks for UTF-8.
#pragma once

#include <sstream>

#include "protomark/types.h"

namespace protomark {

// Joins values into one text.
std::string text(const auto&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

// Throw std::invalid_argument with the text of these parts, `require` unless a condition holds.
[[noreturn]] void invalid(const auto&... parts) { throw std::invalid_argument(text(parts...)); }
void require(bool condition, const auto&... parts) {
  if (!condition) invalid(parts...);
}

// Whether a text is well-formed UTF-8 (Unicode 15, table 3-7).
inline bool is_utf8(std::string_view text) {
  const auto byte = [&](size_t i) {
    return i < text.size() ? static_cast<uint8_t>(text[i]) : uint8_t{0};
  };
  for (size_t i = 0; i < text.size();) {
    const uint8_t lead = byte(i);
    if ((lead >= 0x80 && lead < 0xc2) || lead > 0xf4) return false;
    const size_t size = lead < 0x80 ? 1 : lead < 0xe0 ? 2 : lead < 0xf0 ? 3 : 4;
    // The range of the second byte excludes overlong forms, surrogates and what is beyond U+10FFFF.
    uint8_t low = lead == 0xe0 ? 0xa0 : lead == 0xf0 ? 0x90 : 0x80;
    uint8_t high = lead == 0xed ? 0x9f : lead == 0xf4 ? 0x8f : 0xbf;
    for (size_t j = 1; j < size; ++j) {
      if (byte(i + j) < low || byte(i + j) > high) return false;
      low = 0x80;
      high = 0xbf;
    }
    i += size;
  }
  return true;
}

}  // namespace protomark
