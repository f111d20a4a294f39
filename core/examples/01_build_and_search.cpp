// Builds a map from observations, searches it, saves it and seals it.
//
//   01_build_and_search MODEL.pme FOLDER
#include <cstdio>
#include <filesystem>
#include <memory>
#include <random>
#include <vector>

#include "protomark/protomark.h"

namespace pm = protomark;

int main(int argc, char** argv) try {
  if (argc != 3) {
    std::fprintf(stderr, "usage: %s MODEL.pme FOLDER\n", argv[0]);
    return 2;
  }
  const std::filesystem::path folder = argv[2];
  const auto encoder = std::make_shared<const pm::Encoder>(pm::Encoder::load(argv[1]));

  // Descriptors come from a detector; here 1,000 landmarks are seen four times, with a tenth of the
  // bits wrong each time.
  const std::size_t landmarks = 1000, views = 4, bytes = encoder->bytes();
  std::mt19937 random(0);
  std::vector<std::uint8_t> truth(landmarks * bytes);
  for (auto& byte : truth) byte = static_cast<std::uint8_t>(random());
  const auto observe = [&](std::size_t landmark, std::vector<std::uint8_t>& out) {
    for (std::size_t i = 0; i < bytes; ++i) {
      int noise = 0;
      for (int bit = 0; bit < 8; ++bit) noise |= (random() % 10 == 0) << bit;
      out.push_back(static_cast<std::uint8_t>(truth[landmark * bytes + i] ^ noise));
    }
  };
  std::vector<std::int64_t> ids;
  std::vector<std::uint8_t> descriptors;
  for (std::size_t view = 0; view < views; ++view) {
    for (std::size_t landmark = 0; landmark < landmarks; ++landmark) {
      ids.push_back(static_cast<std::int64_t>(landmark));
      observe(landmark, descriptors);
    }
  }

  pm::PrototypeMap map(encoder);
  map.add(ids, {descriptors.data(), ids.size(), bytes});

  // A new frame: the two nearest landmarks of each descriptor, kept if the first is clearly nearer.
  std::vector<std::uint8_t> frame;
  for (std::size_t landmark = 0; landmark < landmarks; ++landmark) observe(landmark, frame);
  pm::SearchOptions options;
  options.ratio = 0.9;
  const auto [found, distances] = map.search({frame.data(), landmarks, bytes}, 2, options);
  std::size_t accepted = 0, right = 0;
  for (std::size_t i = 0; i < landmarks; ++i) {
    accepted += found.row(i)[0] >= 0;
    right += found.row(i)[0] == static_cast<std::int64_t>(i);
  }
  std::printf("%zu landmarks, %zu matches accepted, %zu right\n", map.size(), accepted, right);

  map.set_metadata({{"frame", "ENU, metres"}, {"source", "example"}});
  map.save(folder / "scene.pmk");
  map.seal(folder / "scene.sealed.pmk", {.bytes_per_landmark = 33});
  const pm::SealedMap sealed(folder / "scene.sealed.pmk");
  std::printf("sealed: %zu landmarks of %.1f bytes\n", sealed.size(), sealed.bytes_per_landmark());
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "error: %s\n", error.what());
  return 1;
}
