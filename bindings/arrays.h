// NumPy arrays in and out.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <cstdint>
#include <memory>
#include <new>
#include <span>
#include <string>
#include <vector>

#include "protomark/matrix_view.h"
#include "protomark/prototypes.h"

namespace protomark::python {

namespace nb = nanobind;

template <typename T>
using Matrix = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <typename T>
using Vector = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// "float64 (3, 2)", for error messages.
inline std::string describe(nb::handle array) {
  const nb::object dtype = array.attr("dtype");
  const nb::object shape = array.attr("shape");
  return std::string(nb::str(nb::handle(dtype)).c_str()) + " " + nb::str(nb::handle(shape)).c_str();
}

inline nb::object numpy(const char* name) { return nb::module_::import_("numpy").attr(name); }

// A 2-D array of exactly this type; `what` says in an error what it should be. A copy only where
// memory is not contiguous.
template <typename T>
Matrix<T> matrix(nb::handle object, const char* type, const char* what) {
  nb::object array = numpy("asarray")(object);
  if (nb::cast<int>(array.attr("ndim")) != 2 || !array.attr("dtype").equal(numpy("dtype")(type))) {
    throw nb::type_error((std::string(what) + " array is needed, not " + describe(array)).c_str());
  }
  return nb::cast<Matrix<T>>(numpy("ascontiguousarray")(array));
}

inline Matrix<std::uint8_t> descriptors(nb::handle object) {
  return matrix<std::uint8_t>(object, "uint8", "descriptors: a (n, bits / 8) uint8");
}

inline Matrix<std::int8_t> codes(nb::handle object) {
  return matrix<std::int8_t>(object, "int8", "codes: a (n, dim) int8");
}

// Landmark ids: any integers, one or many.
inline Vector<std::int64_t> landmarks(nb::handle object) {
  nb::object array = numpy("atleast_1d")(numpy("asarray")(object));
  const auto kind = nb::cast<std::string>(array.attr("dtype").attr("kind"));
  const bool empty = nb::cast<std::size_t>(array.attr("size")) == 0;
  if (nb::cast<int>(array.attr("ndim")) != 1 || (kind != "i" && kind != "u" && !empty)) {
    throw nb::type_error(
        ("landmark ids: a (n,) int64 array is needed, not " + describe(array)).c_str());
  }
  return nb::cast<Vector<std::int64_t>>(
      numpy("ascontiguousarray")(array, nb::arg("dtype") = numpy("int64")));
}

template <typename T>
MatrixView<const T> view(const Matrix<T>& m) {
  return {m.data(), m.shape(0), m.shape(1)};
}

inline std::span<const std::int64_t> view(const Vector<std::int64_t>& v) {
  return {v.data(), v.shape(0)};
}

// A new array that Python owns, and a view to fill it.
template <typename T>
class NewMatrix {
 public:
  // Throws std::bad_alloc where there is no such memory.
  NewMatrix(std::size_t rows, std::size_t columns)
      : data_(new T[size(rows, columns)]()), rows_(rows), columns_(columns) {}

  MatrixView<T> view() const { return {data_.get(), rows_, columns_}; }

  nb::object release() {
    T* data = data_.release();
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<2>>(data, {rows_, columns_}, owner));
  }

 private:
  static std::size_t size(std::size_t rows, std::size_t columns) {
    if (columns != 0 && rows > SIZE_MAX / columns) throw std::bad_alloc();
    return rows * columns;
  }

  std::unique_ptr<T[]> data_;
  std::size_t rows_;
  std::size_t columns_;
};

template <typename T>
nb::object new_vector(std::vector<T> values) {
  auto* held = new std::vector<T>(std::move(values));
  nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(held->data(), {held->size()}, owner));
}

inline std::vector<Position> to_positions(nb::handle object) {
  nb::object array = numpy("ascontiguousarray")(object, nb::arg("dtype") = numpy("float64"));
  const auto m = nb::cast<nb::ndarray<const double, nb::c_contig, nb::device::cpu>>(array);
  if (m.ndim() != 2 || m.shape(1) != 3) {
    throw nb::type_error(
        ("positions: a (n, 3) float64 array is needed, not " + describe(array)).c_str());
  }
  std::vector<Position> result(m.shape(0));
  for (std::size_t i = 0; i < result.size(); ++i) {
    for (std::size_t j = 0; j < 3; ++j) result[i][j] = m.data()[3 * i + j];
  }
  return result;
}

inline nb::object from_positions(std::vector<Position> positions) {
  auto* held = new std::vector<Position>(std::move(positions));
  nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<Position>*>(p); });
  auto* data = reinterpret_cast<double*>(held->data());
  return nb::cast(nb::ndarray<nb::numpy, double, nb::ndim<2>>(data, {held->size(), 3}, owner));
}

}  // namespace protomark::python
