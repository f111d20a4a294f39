// Texts of errors.
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>

namespace protomark {

// Joins values into one text.
template <typename... Parts>
std::string text(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

// Throws std::invalid_argument with the text of these parts.
template <typename... Parts>
[[noreturn]] void invalid(const Parts&... parts) {
  throw std::invalid_argument(text(parts...));
}

}  // namespace protomark
