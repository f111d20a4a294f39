// Build a map from observations, search it, save it, seal it.
//
//   01_build_and_search MODEL.pme FOLDER
#include <cstdio>
#include <filesystem>
#include <memory>
#include <random>
#include <vector>

#include "protomark/encoder.h"
#include "protomark/map_file.h"
#include "protomark/prototypes.h"

namespace pm = protomark;

int main(int argc, char** argv) try {
  if (argc != 3) {
    std::fprintf(stderr, "usage: %s MODEL.pme FOLDER\n", argv[0]);
    return 2;
  }
  const std::filesystem::path folder = argv[2];
  const auto encoder = std::make_shared<const pm::Encoder>(pm::Encoder::load(argv[1]));

  // Descriptors come from a detector; here 1,000 landmarks are seen four times, each time with a
  // tenth of the bits wrong.
  const std::size_t landmarks = 1000, views = 4, bytes = encoder->bytes();
  std::mt19937 random(0);
  std::vector<std::uint8_t> truth(landmarks * bytes);
  for (auto& byte : truth) byte = static_cast<std::uint8_t>(random());
  const auto observe = [&](std::size_t landmark, std::vector<std::uint8_t>& out) {
    for (std::size_t i = 0; i < bytes; ++i) {
      std::uint8_t noise = 0;
      for (int bit = 0; bit < 8; ++bit) noise |= (random() % 10 == 0) << bit;
      out.push_back(truth[landmark * bytes + i] ^ noise);
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

  // A new frame: two neighbours a descriptor, kept where the first is clearly nearer.
  std::vector<std::uint8_t> frame;
  for (std::size_t landmark = 0; landmark < landmarks; ++landmark) observe(landmark, frame);
  std::vector<std::int64_t> found(landmarks * 2);
  std::vector<std::int32_t> distances(landmarks * 2);
  pm::SearchOptions options;
  options.ratio = 0.9;
  map.search({frame.data(), landmarks, bytes}, options, {found.data(), landmarks, 2},
             {distances.data(), landmarks, 2});
  std::size_t accepted = 0, right = 0;
  for (std::size_t i = 0; i < landmarks; ++i) {
    accepted += found[2 * i] >= 0;
    right += found[2 * i] == static_cast<std::int64_t>(i);
  }
  std::printf("%zu landmarks, %zu matches accepted, %zu right\n", map.size(), accepted, right);

  map.set_metadata({{"frame", "ENU, metres"}, {"source", "example"}});
  map.save(folder / "scene.pmk");
  map.seal(folder / "scene.sealed.pmk");
  const pm::SealedMap sealed(folder / "scene.sealed.pmk");
  std::printf("sealed: %zu landmarks of %zu bytes\n", sealed.size(), sealed.dim() + 1);
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "error: %s\n", error.what());
  return 1;
}
