// Stands in for the user's own PnP: where a camera is, from matches that may be wrong. With OpenCV
// it is cv::solvePnPRansac; without, it takes the camera's attitude for known, as from an IMU.
#pragma once

#include <optional>
#include <random>
#include <vector>

#include "world.h"

#ifdef EXAMPLE_WITH_OPENCV
#include <opencv2/calib3d.hpp>

#include "protomark/opencv.h"
#endif

namespace example {

inline constexpr double kMaxError = 3;  // pixels

#ifdef EXAMPLE_WITH_OPENCV
inline std::optional<pm::Position> pnp(const std::vector<pm::Position>& world,
                                       const std::vector<Pixel>& pixels) {
  std::vector<cv::Point2d> image;
  for (const auto& [u, v] : pixels) image.emplace_back(u, v);
  const cv::Matx33d camera(kFocal, 0, kWidth / 2, 0, kFocal, kHeight / 2, 0, 0, 1);
  cv::Vec3d rotation, translation;
  cv::Mat inliers;
  if (!cv::solvePnPRansac(pm::points(world), image, camera, {}, rotation, translation, false, 1000,
                          kMaxError, 0.999, inliers) ||
      2 * static_cast<std::size_t>(inliers.rows) < world.size()) {
    return std::nullopt;
  }
  cv::Matx33d cam_from_world;
  cv::Rodrigues(rotation, cam_from_world);
  const cv::Vec3d centre = -(cam_from_world.t() * translation);
  return pm::Position{centre[0], centre[1], centre[2]};
}
#else
// The position whose rays fit best: u (Z - z) = X - x, v (Z - z) = Y - y are linear in (x, y, z).
inline pm::Position fit(const std::vector<pm::Position>& world, const std::vector<Pixel>& pixels,
                        const std::vector<std::size_t>& rows) {
  double mean[2] = {}, mean_ray[2] = {}, product = 0, square = 0;
  const auto ray = [&](std::size_t r, int axis) {
    return (pixels[r][axis] - (axis == 0 ? kWidth : kHeight) / 2) / kFocal;
  };
  const auto value = [&](std::size_t r, int axis) {
    return world[r][axis] - ray(r, axis) * world[r][2];
  };
  for (int axis = 0; axis < 2; ++axis) {
    for (const std::size_t r : rows) {
      mean[axis] += value(r, axis) / rows.size();
      mean_ray[axis] += ray(r, axis) / rows.size();
    }
    for (const std::size_t r : rows) {
      product += (ray(r, axis) - mean_ray[axis]) * (value(r, axis) - mean[axis]);
      square += (ray(r, axis) - mean_ray[axis]) * (ray(r, axis) - mean_ray[axis]);
    }
  }
  const double z = -product / square;
  return {mean[0] + mean_ray[0] * z, mean[1] + mean_ray[1] * z, z};
}

inline std::optional<pm::Position> pnp(const std::vector<pm::Position>& world,
                                       const std::vector<Pixel>& pixels) {
  std::vector<std::size_t> best;
  std::mt19937 random(0);
  for (int i = 0; i < 100; ++i) {  // RANSAC
    const auto [x, y, z] = fit(world, pixels, {random() % world.size(), random() % world.size()});
    std::vector<std::size_t> inliers;
    for (std::size_t r = 0; r < world.size(); ++r) {
      const double depth = world[r][2] - z;
      const double u = kFocal * (world[r][0] - x) / depth + kWidth / 2 - pixels[r][0];
      const double v = kFocal * (world[r][1] - y) / depth + kHeight / 2 - pixels[r][1];
      if (depth > 0 && u * u + v * v < kMaxError * kMaxError) inliers.push_back(r);
    }
    if (inliers.size() > best.size()) best = std::move(inliers);
  }
  if (2 * best.size() < world.size()) return std::nullopt;
  return fit(world, pixels, best);
}
#endif

}  // namespace example
