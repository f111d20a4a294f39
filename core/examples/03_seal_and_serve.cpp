// Seals a map, maps the file into memory and answers from it, on several threads.
//
//   03_seal_and_serve MODEL.pme FOLDER
#include <thread>

#include "world.h"

bool run(const std::shared_ptr<const pm::Encoder>& encoder, const std::filesystem::path& folder) {
  example::World world(2000, encoder->bytes());
  pm::PrototypeMap map(encoder, /*dim=*/48, /*appearance_bits=*/10);
  example::map_world(world, map);
  map.build_index();  // worth it from some ten thousand landmarks on
  const std::filesystem::path path = folder / "serve.pmk";
  map.seal(path, {.bytes_per_landmark = 33, .position_bits = 16});

  // Opening reads no more than the sizes; all processes that open the file share its memory.
  const pm::SealedMap sealed(path);
  std::vector<example::Frame> frames;
  for (int i = 0; i < 8; ++i) frames.push_back(world.frame(1.2 + 2.4 * i));
  std::vector<pm::MatchList> found(frames.size());
  const auto serve = [&](std::size_t first) {
    for (std::size_t i = first; i < frames.size(); i += 2) {
      found[i] = pm::match(sealed, frames[i].descriptors(), {.recall = 0.98});
    }
  };
  std::thread other(serve, 1);
  serve(0);
  other.join();

  std::size_t keypoints = 0, matches = 0, right = 0;
  for (std::size_t i = 0; i < frames.size(); ++i) {
    keypoints += frames[i].size();
    matches += found[i].size();
    right += example::right(found[i], frames[i]);
  }
  std::printf("%.1f bytes per landmark; %zu matches of %zu keypoints, %zu right\n",
              sealed.bytes_per_landmark(), matches, keypoints, right);
  return right > 0.95 * keypoints && right > 0.99 * matches;
}

int main(int argc, char** argv) { return example::main(argc, argv, run); }
