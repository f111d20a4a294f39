// A row-major matrix that somebody else owns.
#pragma once

#include <cstddef>
#include <cstdint>

namespace protomark {

template <typename T>
struct MatrixView {
  T* data = nullptr;
  std::size_t rows = 0;
  std::size_t columns = 0;

  T* row(std::size_t i) const { return data + i * columns; }
};

// One descriptor a row; bit i of a descriptor is bit i % 8 (least significant first) of byte i / 8.
using Descriptors = MatrixView<const std::uint8_t>;
// One code a row, values -127 to 127.
using Codes = MatrixView<const std::int8_t>;

}  // namespace protomark
