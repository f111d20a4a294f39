// protomark/eigen.h: views show the same numbers, copies keep them.
#include "protomark/eigen.h"

#include <cmath>

#include "check.h"
#include "random.h"

using namespace protomark;

namespace {

const std::vector<Position> kPositions = {{1, 2, 3}, {4, 5, 6}, {7, 8, 9}, {0.1, -1, 1e9}};

void test_views() {
  const auto matrix = as_eigen(kPositions);
  CHECK(matrix.cols() == 4 && matrix.col(1) == Eigen::Vector3d(4, 5, 6));
  CHECK(matrix.data() == kPositions.front().data());
  CHECK(as_eigen(std::span<const Position>()).cols() == 0);

  Matrix<float> prototypes(2, 3);
  prototypes.row(1)[2] = 7;
  const auto view = as_eigen(prototypes);
  CHECK(view.rows() == 2 && view.cols() == 3 && view(1, 2) == 7 && view.sum() == 7);
  const std::vector<std::int8_t> codes = {1, 2, 3, 4};
  CHECK(as_eigen(Codes{codes.data(), 2, 2})(1, 0) == 3);
  CHECK(as_eigen(Matrix<std::int64_t>()).size() == 0);
}

void test_copies() {
  const Eigen::Matrix3Xd columns = as_eigen(kPositions);
  CHECK(to_positions(columns) == kPositions);
  const Eigen::MatrixX3d rows = columns.transpose();
  CHECK(to_positions(rows) == kPositions);
  CHECK(to_positions(columns.transpose()) == kPositions);
  const Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor> packed = rows;
  CHECK(to_positions(packed) == kPositions);
  // Expressions, maps, parts, floats, one point.
  CHECK(to_positions(columns.rightCols(2)) ==
        std::vector<Position>(kPositions.begin() + 2, kPositions.end()));
  CHECK(to_positions(2 * rows.topRows(1)) == std::vector<Position>{{2, 4, 6}});
  const float floats[] = {1, 2, 3, 4, 5, 6};
  CHECK(to_positions(Eigen::Map<const Eigen::Matrix3Xf>(floats, 3, 2)) ==
        std::vector<Position>(kPositions.begin(), kPositions.begin() + 2));
  CHECK(to_positions(Eigen::Vector3d(1, 2, 3)) == std::vector<Position>{{1, 2, 3}});
  CHECK(to_positions(Eigen::Matrix3Xd(3, 0)).empty());
  CHECK(to_positions(Eigen::MatrixX3d(0, 3)).empty());
}

void test_round_trip() {
  const auto encoder = test::random_encoder();
  PrototypeMap map(encoder);
  const std::vector<std::int64_t> ids = {3, 5};
  const std::vector<std::uint8_t> bytes(2 * encoder->bytes(), 1);
  map.add(ids, {bytes.data(), 2, encoder->bytes()});
  Eigen::Matrix3Xd world(3, 2);
  world << 1, 2, 3, 4, 5, 6;
  map.set_positions(ids, to_positions(world));
  const Eigen::Matrix3Xd back = as_eigen(map.positions(ids));
  CHECK(back == world);
  map.set_positions(ids, to_positions(Eigen::Matrix3Xd::Constant(3, 2, NAN)));
  CHECK(std::isnan(map.positions(ids)[0][0]));
}

}  // namespace

int main() {
  test_views();
  test_copies();
  test_round_trip();
  return check::result();
}
