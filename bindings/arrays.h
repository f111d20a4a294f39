// Converts NumPy arrays.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <limits>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "protomark/encoder.h"

namespace protomark::python {

namespace nb = nanobind;
using namespace nb::literals;

template <typename T>
using Array1 = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <typename T>
using Array2 = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <typename T>
using Array3 = nb::ndarray<const T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

inline nb::object numpy(const char* name) { return nb::module_::import_("numpy").attr(name); }

[[noreturn]] inline void type_error(const std::string& what) { throw nb::type_error(what.c_str()); }

// Describes an array in errors, as in "float64 (3, 2)".
inline std::string describe(nb::handle array) {
  const nb::object dtype = array.attr("dtype");
  const nb::object shape = array.attr("shape");
  return std::string(nb::str(nb::handle(dtype)).c_str()) + " " + nb::str(nb::handle(shape)).c_str();
}

// Returns an array of exactly this type and number of dimensions, or throws an error that begins
// with `what`. Copies only memory that is not contiguous.
template <typename Array>
Array array_of(nb::handle object, const char* type, int dimensions, const char* what) {
  // OpenCV's descriptors of an image without keypoints.
  if (object.is_none()) type_error(std::string(what) + " array is needed, not None");
  nb::object array = numpy("asarray")(object);
  if (nb::cast<int>(array.attr("ndim")) != dimensions ||
      !array.attr("dtype").equal(numpy("dtype")(type))) {
    type_error(std::string(what) + " array is needed, not " + describe(array));
  }
  return nb::cast<Array>(numpy("ascontiguousarray")(array));
}

// Descriptors as an encoder takes them.
using DescriptorArray = nb::ndarray<nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

inline DescriptorArray descriptors(nb::handle object, const Encoder& encoder) {
  const bool floats = encoder.input().kind == InputKind::float32;
  const std::size_t columns = encoder.bytes() / (floats ? sizeof(float) : 1);
  const char* type = floats ? "float32" : "uint8";
  const std::string what = "descriptors: a (n, " + std::to_string(columns) + ") " + type;
  return array_of<DescriptorArray>(object, type, 2, what.c_str());
}

inline Descriptors view(const DescriptorArray& array) {
  return {static_cast<const std::uint8_t*>(array.data()), array.shape(0),
          array.shape(1) * array.itemsize()};
}

inline Array2<std::int8_t> codes(nb::handle object) {
  return array_of<Array2<std::int8_t>>(object, "int8", 2, "codes: a (n, dim) int8");
}

inline bool is_int8(nb::handle object) {
  return numpy("asarray")(object).attr("dtype").equal(numpy("dtype")("int8"));
}

// Converts one integer or an array of integers of any type.
inline Array1<std::int64_t> landmark_ids(nb::handle object) {
  nb::object array = numpy("atleast_1d")(numpy("asarray")(object));
  const auto kind = nb::cast<std::string>(array.attr("dtype").attr("kind"));
  const bool empty = nb::cast<std::size_t>(array.attr("size")) == 0;
  if (nb::cast<int>(array.attr("ndim")) != 1 || (kind != "i" && kind != "u" && !empty)) {
    type_error("landmark ids: a (n,) int64 array is needed, not " + describe(array));
  }
  if (kind == "u" && !empty) {
    const auto largest = nb::cast<std::uint64_t>(array.attr("max")());
    if (largest > INT64_MAX) {
      throw std::invalid_argument("landmark id " + std::to_string(largest) + " is above 2**63 - 1");
    }
  }
  return nb::cast<Array1<std::int64_t>>(
      numpy("ascontiguousarray")(array, nb::arg("dtype") = numpy("int64")));
}

// Converts an integer. One beyond T becomes the nearest T, which the call then refuses.
template <typename T>
T integer(nb::handle object, const char* what) {
  const auto number = nb::steal(PyNumber_Index(object.ptr()));
  if (!number.is_valid()) {
    PyErr_Clear();
    type_error(std::string(what) + ": an integer is needed, not " + nb::repr(object).c_str());
  }
  int beyond = 0;
  const long long value = PyLong_AsLongLongAndOverflow(number.ptr(), &beyond);
  if (beyond > 0 || std::cmp_greater(value, std::numeric_limits<T>::max())) {
    return std::numeric_limits<T>::max();
  }
  if (beyond < 0 || std::cmp_less(value, std::numeric_limits<T>::min())) {
    return std::numeric_limits<T>::min();
  }
  return static_cast<T>(value);
}

// Converts a length of codes; None becomes 0, which the core takes for the full one.
inline std::size_t code_length(nb::handle object) {
  if (object.is_none()) return 0;
  const auto dim = integer<std::size_t>(object, "dim");
  if (dim == 0) throw nb::value_error("dim must be at least 1");
  return dim;
}

inline std::vector<Position> positions(nb::handle object) {
  nb::object array = numpy("ascontiguousarray")(object, nb::arg("dtype") = numpy("float64"));
  const auto m = nb::cast<nb::ndarray<const double, nb::c_contig, nb::device::cpu>>(array);
  if (m.ndim() != 2 || m.shape(1) != 3) {
    type_error("positions: a (n, 3) float64 array is needed, not " + describe(array));
  }
  std::vector<Position> result(m.shape(0));
  for (std::size_t i = 0; i < m.size(); ++i) result[i / 3][i % 3] = m.data()[i];
  return result;
}

template <typename T>
MatrixView<const T> view(const Array2<T>& array) {
  return {array.data(), array.shape(0), array.shape(1)};
}

template <typename T>
std::span<const T> view(const Array1<T>& array) {
  return {array.data(), array.shape(0)};
}

// Returns a NumPy array of this shape that owns `elements`, each of one or more T.
template <typename T, std::size_t Dimensions, typename Element>
nb::object to_array(std::vector<Element> elements, const std::size_t (&shape)[Dimensions]) {
  auto* held = new std::vector<Element>(std::move(elements));
  nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<Element>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, T>(held->data(), Dimensions, shape, owner));
}

template <typename T>
nb::object to_numpy(std::vector<T> values) {
  const std::size_t n = values.size();
  return to_array<T>(std::move(values), {n});
}

template <typename T>
nb::object to_numpy(Matrix<T> matrix) {
  const std::size_t rows = matrix.rows, columns = matrix.columns;
  return to_array<T>(std::move(matrix.data), {rows, columns});
}

inline nb::object to_numpy(std::vector<Position> values) {
  const std::size_t n = values.size();
  return to_array<double>(std::move(values), {n, 3});
}

inline nb::tuple to_numpy(Matches matches) {
  return nb::make_tuple(to_numpy(std::move(matches.ids)), to_numpy(std::move(matches.distances)));
}

}  // namespace protomark::python
