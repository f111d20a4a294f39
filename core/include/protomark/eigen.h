// Eigen's types as Protomark's. Optional: protomark.h does not include it; needs Eigen 3.
#pragma once

#include <Eigen/Core>
#include <type_traits>

#include "protomark/types.h"

namespace protomark {

// Shows positions as a matrix of 3 x n, one per column, in the memory of the span.
inline Eigen::Map<const Eigen::Matrix3Xd> as_eigen(std::span<const Position> positions) {
  static_assert(sizeof(Position) == 3 * sizeof(double));
  return {positions.empty() ? nullptr : positions.front().data(), 3,
          static_cast<Eigen::Index>(positions.size())};
}

// Shows prototypes, codes, ids or distances as a row-major matrix, in their own memory.
template <typename T>
using RowMajor =
    Eigen::Matrix<std::remove_const_t<T>, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
template <typename T>
Eigen::Map<const RowMajor<T>> as_eigen(MatrixView<T> matrix) {
  return {matrix.data, static_cast<Eigen::Index>(matrix.rows),
          static_cast<Eigen::Index>(matrix.columns)};
}
template <typename T>
Eigen::Map<const RowMajor<T>> as_eigen(const Matrix<T>& matrix) {
  return as_eigen(matrix.view());
}

// Copies points to positions: the columns of a matrix of 3 x n, or the rows of one of n x 3.
template <typename Points>
std::vector<Position> to_positions(const Eigen::MatrixBase<Points>& points) {
  constexpr bool columns = Points::RowsAtCompileTime == 3;
  static_assert(columns != (Points::ColsAtCompileTime == 3),
                "points must be of a type with 3 rows (one point per column) or 3 columns (one per "
                "row), such as Eigen::Matrix3Xd or Eigen::MatrixX3d");
  const Eigen::Index n = columns ? points.cols() : points.rows();
  std::vector<Position> result(static_cast<size_t>(n));
  Eigen::Map<Eigen::Matrix3Xd> copy(n == 0 ? nullptr : result.front().data(), 3, n);
  if constexpr (columns) {
    copy = points.template cast<double>();
  } else {
    copy = points.template cast<double>().transpose();
  }
  return result;
}

}  // namespace protomark
