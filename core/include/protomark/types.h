// The types that all of Protomark shares: matrices, positions, matches, metadata, errors.
#pragma once

// Exported: files that include this one need not include these.
#include <array>      // IWYU pragma: export
#include <cstddef>    // IWYU pragma: export
#include <cstdint>    // IWYU pragma: export
#include <optional>   // IWYU pragma: export
#include <span>       // IWYU pragma: export
#include <stdexcept>  // IWYU pragma: export
#include <string>     // IWYU pragma: export
#include <vector>     // IWYU pragma: export

#include <map>
#include <new>
#include <type_traits>

// Marks what a shared library exports.
#ifdef PROTOMARK_SHARED
#define PROTOMARK_API __attribute__((visibility("default")))
#else
#define PROTOMARK_API
#endif

namespace protomark {

using std::int16_t, std::int32_t, std::int64_t, std::int8_t, std::size_t;
using std::uint16_t, std::uint32_t, std::uint64_t, std::uint8_t;

// A row-major matrix in memory of the caller.
template <typename T>
struct MatrixView {
  T* data = nullptr;
  size_t rows = 0;
  size_t columns = 0;

  T* row(size_t i) const { return data + i * columns; }
  operator MatrixView<const T>() const  // NOLINT: as T* converts to const T*
    requires(!std::is_const_v<T>)
  {
    return {data, rows, columns};
  }
};

// A row-major matrix that owns its elements.
template <typename T>
struct Matrix {
  Matrix() = default;
  // All zeros. Throws std::bad_alloc.
  Matrix(size_t n, size_t m) : rows(n), columns(m) {
    if (m > PTRDIFF_MAX / sizeof(T) || (m != 0 && n > PTRDIFF_MAX / sizeof(T) / m))
      throw std::bad_alloc();
    data.resize(n * m);
  }

  T* row(size_t i) { return data.data() + i * columns; }
  const T* row(size_t i) const { return data.data() + i * columns; }
  MatrixView<T> view() { return {data.data(), rows, columns}; }
  MatrixView<const T> view() const { return {data.data(), rows, columns}; }
  operator MatrixView<const T>() const { return view(); }  // NOLINT: a view costs nothing
  bool operator==(const Matrix&) const = default;

  size_t rows = 0;
  size_t columns = 0;
  std::vector<T> data;
};

// One descriptor per row, as OpenCV gives them: bit i of a descriptor is bit i % 8 (least
// significant first) of byte i / 8.
using Descriptors = MatrixView<const uint8_t>;
// One code per row, each number -127 to 127.
using Codes = MatrixView<const int8_t>;

// World coordinates of a landmark; NaN in all three if it has none.
using Position = std::array<double, 3>;

// The k nearest neighbours of each query, nearest first.
struct Matches {
  Matrix<int64_t> ids;        // (queries x k); -1 where there is no neighbour
  Matrix<int32_t> distances;  // (queries x k); INT32_MAX where there is none
  bool operator==(const Matches&) const = default;
};

// The user's texts about a map, by name, in UTF-8. Two names have a meaning:
//   "frame"    the coordinate frame and unit of the positions, as in "ENU, metres"
//   "created"  when the map was begun, in UTC (ISO 8601): "2026-11-23T03:39:41Z"
// The library itself writes none, so that equal maps are equal files.
using Metadata = std::map<std::string, std::string>;

inline constexpr size_t kMaxMetadata = 256;          // names
inline constexpr size_t kMaxMetadataName = 128;      // bytes, at least 1
inline constexpr size_t kMaxMetadataText = 1 << 16;  // bytes

// Throws std::invalid_argument beyond these limits, for bad UTF-8 and for a bad "created".
PROTOMARK_API void check_metadata(const Metadata& metadata);

struct MapSummary {
  uint64_t observations = 0;
  // Number of landmarks with i observations, at index i; with 255 or more at the last index.
  std::array<int64_t, 256> count_histogram{};
  size_t landmarks_with_position = 0;
  // Lowest and highest coordinates; nullopt if no landmark has a position.
  std::optional<std::array<Position, 2>> extent;
};

// Thrown if a file cannot be read or written, or is broken.
struct PROTOMARK_API FileError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// Thrown for a landmark id that the map does not hold.
struct PROTOMARK_API UnknownLandmark : std::out_of_range {
  explicit UnknownLandmark(int64_t unknown)
      : std::out_of_range("landmark " + std::to_string(unknown) + " is not in the map"),
        id(unknown) {}
  int64_t id;
};

// Returns the instruction set of the kernels, such as "avx512", "avx2", "neon" or "portable": the
// best that this CPU runs, or the one that the environment variable PROTOMARK_ISA names. Throws
// std::invalid_argument if that does not run here. Results are the same with all of them.
PROTOMARK_API const char* instruction_set();

}  // namespace protomark
