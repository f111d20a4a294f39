// A made-up world for the examples: landmarks with positions and descriptors, and frames of them.
// Yours has a camera, a detector and a SLAM or SfM system in its place.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <memory>
#include <random>
#include <vector>

#include "protomark/protomark.h"

namespace pm = protomark;

namespace example {

using Pixel = std::array<double, 2>;

inline constexpr double kFocal = 500, kWidth = 640, kHeight = 480;

// The keypoints of an image. What sees what is there to check the examples.
struct Frame {
  std::vector<Pixel> pixels;
  std::vector<std::uint8_t> bytes;
  std::vector<std::int64_t> truth;  // the landmark that each keypoint sees

  std::size_t size() const { return pixels.size(); }
  pm::Descriptors descriptors() const {
    return {bytes.data(), size(), size() == 0 ? 0 : bytes.size() / size()};
  }
};

class World {
 public:
  World(std::size_t landmarks, std::size_t descriptor_bytes, std::uint32_t seed = 0)
      : random_(seed),
        positions_(landmarks),
        bytes_(descriptor_bytes),
        truth_(landmarks * descriptor_bytes) {
    for (auto& position : positions_) position = {20 * unit(), 6 * unit() - 3, 4 + 4 * unit()};
    for (auto& byte : truth_) byte = static_cast<std::uint8_t>(random_());
  }

  std::size_t size() const { return positions_.size(); }
  std::vector<pm::Position> positions(const std::vector<std::int64_t>& landmarks) const {
    std::vector<pm::Position> result;
    for (const std::int64_t i : landmarks) {
      result.push_back(positions_[static_cast<std::size_t>(i)]);
    }
    return result;
  }

  // Looks along z from (x, 0, 0). One bit in twenty of each descriptor is wrong, and pixels are
  // up to half a pixel off.
  Frame frame(double x) {
    Frame frame;
    for (std::size_t i = 0; i < positions_.size(); ++i) {
      const auto& [px, py, pz] = positions_[i];
      const double u = kFocal * (px - x) / pz + kWidth / 2, v = kFocal * py / pz + kHeight / 2;
      if (u < 0 || u >= kWidth || v < 0 || v >= kHeight) continue;
      frame.pixels.push_back({u + unit() - 0.5, v + unit() - 0.5});
      frame.truth.push_back(static_cast<std::int64_t>(i));
      for (std::size_t b = 0; b < bytes_; ++b) {
        int wrong = 0;
        for (int bit = 0; bit < 8; ++bit) wrong |= (random_() % 20 == 0) << bit;
        frame.bytes.push_back(static_cast<std::uint8_t>(truth_[i * bytes_ + b] ^ wrong));
      }
    }
    return frame;
  }

 private:
  double unit() { return static_cast<double>(random_()) / 4294967296.0; }

  std::mt19937 random_;
  std::vector<pm::Position> positions_;
  std::size_t bytes_;
  std::vector<std::uint8_t> truth_;  // descriptors
};

// Adds the observations of frames along the x axis, and the positions of what they see.
inline void map_world(World& world, pm::PrototypeMap& map) {
  for (int i = 0; i <= 40; ++i) {
    const Frame frame = world.frame(0.5 * i);
    map.add(frame.truth, frame.descriptors());
  }
  const std::vector<std::int64_t> ids = map.ids();
  map.set_positions(ids, world.positions(ids));
}

// How many matches are right.
inline std::size_t right(const pm::MatchList& matches, const Frame& frame) {
  std::size_t result = 0;
  for (std::size_t i = 0; i < matches.size(); ++i) {
    result += frame.truth[matches.keypoints[i]] == matches.landmarks[i];
  }
  return result;
}

// The main function of an example: `run` takes the encoder in MODEL.pme and a folder to write to,
// and returns whether its results are right.
template <typename Run>
int main(int argc, char** argv, const Run& run) try {
  if (argc != 3) {
    std::fprintf(stderr, "usage: %s MODEL.pme FOLDER\n", argv[0]);
    return 2;
  }
  const auto encoder = std::make_shared<const pm::Encoder>(pm::Encoder::load(argv[1]));
  return run(encoder, std::filesystem::path(argv[2])) ? 0 : 1;
} catch (const std::exception& error) {
  std::fprintf(stderr, "error: %s\n", error.what());
  return 1;
}

}  // namespace example
