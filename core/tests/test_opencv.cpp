// protomark/opencv.h: cv::Mat of any layout gives the same answers as plain memory.
#include "protomark/opencv.h"

#include <cmath>
#include <opencv2/features2d.hpp>

#include "check.h"
#include "random.h"

using namespace protomark;
using protomark::test::Random;

namespace {

std::vector<std::uint8_t> bytes_of(Descriptors d) { return {d.data, d.data + d.rows * d.columns}; }

void test_layouts() {
  Random random(1);
  auto bytes = random.integers<std::uint8_t>(50 * 20, 0, 255);
  const cv::Mat wide(50, 20, CV_8U, bytes.data());
  const Descriptors same = MatDescriptors(wide);
  CHECK(same.data == bytes.data() && same.rows == 50 && same.columns == 20);
  const MatDescriptors rows(wide.rowRange(3, 9));  // adjacent: no copy
  CHECK(Descriptors(rows).data == bytes.data() + 60 && Descriptors(rows).rows == 6);

  const MatDescriptors part(wide(cv::Rect(4, 2, 8, 30)));  // its rows are 20 bytes apart
  const Descriptors view = part;
  CHECK(view.rows == 30 && view.columns == 8);
  for (int r = 0; r < 30; ++r) {
    CHECK(std::equal(view.row(static_cast<std::size_t>(r)),
                     view.row(static_cast<std::size_t>(r)) + 8, wide.ptr<std::uint8_t>(r + 2) + 4));
  }
  // The Mat may go: its memory is held.
  const MatDescriptors held(cv::Mat(2, 8, CV_8U, cv::Scalar(7)));
  CHECK(bytes_of(held) == std::vector<std::uint8_t>(16, 7));
}

void test_empty() {
  const auto encoder = test::random_encoder();
  PrototypeMap map(encoder);
  for (const cv::Mat& empty : {cv::Mat(), cv::Mat(0, 8, CV_8U), cv::Mat(0, 0, CV_32F)}) {
    const MatDescriptors none(empty);
    map.add({}, none);
    map.subtract({}, none);
    CHECK(map.size() == 0 && map.search(none).ids.rows == 0);
    CHECK(encoder->encode(none).rows == 0);
    const std::vector<std::uint8_t> database(2 * 8);
    CHECK(hamming_search(MatDescriptors(empty, 8), {database.data(), 2, 8}).ids.rows == 0);
  }
  std::vector<cv::KeyPoint> keypoints;
  cv::Mat descriptors;
  cv::ORB::create()->detectAndCompute(cv::Mat(64, 64, CV_8U, cv::Scalar(0)), {}, keypoints,
                                      descriptors);
  CHECK(keypoints.empty() && Descriptors(MatDescriptors(descriptors)).rows == 0);
}

void test_refused() {
  const int three[] = {2, 2, 2};
  for (const cv::Mat& wrong : {cv::Mat(2, 8, CV_32F), cv::Mat(2, 8, CV_8S), cv::Mat(2, 8, CV_8UC3),
                               cv::Mat(3, three, CV_8U)}) {
    CHECK(check::throws<std::invalid_argument>([&] { MatDescriptors{wrong}; },
                                               "CV_8UC1 with 2 dimensions is needed, not CV_"));
  }
}

void test_orb() {
  Random random(2);
  auto pixels = random.integers<std::uint8_t>(240 * 320, 0, 255);
  cv::Mat image(240, 320, CV_8U, pixels.data()), descriptors;
  std::vector<cv::KeyPoint> keypoints;
  cv::ORB::create(200)->detectAndCompute(image, {}, keypoints, descriptors);
  const auto encoder = test::random_encoder(256);
  std::vector<std::int64_t> ids;
  for (int i = 0; i < descriptors.rows; ++i) ids.push_back(i);
  PrototypeMap map(encoder);
  map.add(ids, MatDescriptors(descriptors));
  const Matches found = map.search(MatDescriptors(descriptors));
  CHECK(found.ids.rows > 100);
  for (std::size_t i = 0; i < found.ids.rows; ++i) CHECK(found.distances.row(i)[0] == 0);
}

void test_points() {
  const std::vector<Position> positions = {{1, 2, 3}, {NAN, NAN, NAN}};
  const auto found = points(positions);
  CHECK(found.size() == 2 && found[0] == cv::Point3d(1, 2, 3) && std::isnan(found[1].x));
  CHECK(points({}).empty());
}

}  // namespace

int main() {
  test_layouts();
  test_empty();
  test_refused();
  test_orb();
  test_points();
  return check::result();
}
