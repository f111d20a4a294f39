// OpenCV's types as Protomark's. Optional: protomark.h does not include it; needs opencv_core.
#pragma once

#include <opencv2/core.hpp>

#include "protomark/types.h"

namespace protomark {

// The descriptors in a cv::Mat, as detectAndCompute gives them, for any call that takes
// Descriptors: map.search(MatDescriptors(mat)). Shares the memory of the Mat, or holds a copy where
// rows are not adjacent. An empty Mat, of a frame without keypoints, has no rows, of `bytes`
// columns; maps and encoders need not be told how many.
class MatDescriptors {
 public:
  // Throws std::invalid_argument unless the Mat is empty or of two dimensions and CV_8UC1.
  explicit MatDescriptors(const cv::Mat& mat, size_t bytes = 0) : bytes_(bytes) {
    if (mat.empty()) return;
    if (mat.dims != 2 || mat.type() != CV_8UC1) {
      throw std::invalid_argument(
          "descriptors: a cv::Mat of type CV_8UC1 with 2 dimensions is needed, not " +
          cv::typeToString(mat.type()) + " with " + std::to_string(mat.dims));
    }
    mat_ = mat.isContinuous() ? mat : mat.clone();
    bytes_ = static_cast<size_t>(mat.cols);
  }
  operator Descriptors() const {  // NOLINT: a view costs nothing
    return {mat_.data, static_cast<size_t>(mat_.rows), bytes_};
  }

 private:
  cv::Mat mat_;
  size_t bytes_;
};

// Positions as cv::solvePnP takes them; those of landmarks without one are NaN.
inline std::vector<cv::Point3d> points(std::span<const Position> positions) {
  std::vector<cv::Point3d> result;
  for (const auto& [x, y, z] : positions) result.emplace_back(x, y, z);
  return result;
}

}  // namespace protomark
