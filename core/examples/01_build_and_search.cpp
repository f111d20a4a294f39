// Builds a map from observations, searches it, saves it and seals it.
//
//   01_build_and_search MODEL.pme FOLDER
#include "world.h"

bool run(const std::shared_ptr<const pm::Encoder>& encoder, const std::filesystem::path& folder) {
  example::World world(2000, encoder->bytes());
  pm::PrototypeMap map(encoder);
  for (int i = 0; i <= 40; ++i) {
    const example::Frame frame = world.frame(0.5 * i);
    map.add(frame.truth, frame.descriptors());  // a landmark's id and descriptor, of each keypoint
  }

  // A new frame: the two nearest landmarks of each descriptor, kept if the first is clearly nearer.
  const example::Frame frame = world.frame(7.3);
  pm::SearchOptions options;
  options.ratio = 0.9;
  const auto [ids, distances] = map.search(frame.descriptors(), 2, options);
  std::size_t kept = 0, right = 0;
  for (std::size_t i = 0; i < frame.size(); ++i) {
    kept += ids.row(i)[0] >= 0;
    right += ids.row(i)[0] == frame.truth[i];
  }
  // The same by how likely a match is right, each landmark once.
  const pm::MatchList matches = pm::match(map, frame.descriptors());
  std::printf("%zu landmarks; of %zu keypoints %zu pass the ratio test, %zu right; %zu matches\n",
              map.size(), frame.size(), kept, right, matches.size());

  map.set_metadata({{"frame", "ENU, metres"}, {"source", "example"}});
  map.save(folder / "scene.pmk");
  map.seal(folder / "scene.sealed.pmk", {.bytes_per_landmark = 33});
  const pm::SealedMap sealed(folder / "scene.sealed.pmk");
  std::printf("sealed: %zu landmarks of %.1f bytes\n", sealed.size(), sealed.bytes_per_landmark());
  return right > 0.95 * frame.size() && example::right(matches, frame) > 0.95 * frame.size();
}

int main(int argc, char** argv) { return example::main(argc, argv, run); }
