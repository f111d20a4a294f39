// What goes wrong, by kind. Wrong arguments are std::invalid_argument.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

namespace protomark {

// A file that cannot be read or written, or that is not what it should be.
struct FileError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// A landmark id that the map does not hold.
struct UnknownLandmark : std::out_of_range {
  explicit UnknownLandmark(std::int64_t id)
      : std::out_of_range("landmark " + std::to_string(id) + " is not in the map"), id(id) {}
  std::int64_t id;
};

}  // namespace protomark
