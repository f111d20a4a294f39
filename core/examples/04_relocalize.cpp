// Finds where a frame was taken, in a sealed map, by the user's own PnP.
//
//   04_relocalize MODEL.pme FOLDER
#include <cmath>

#include "pnp.h"
#include "world.h"

// All of the relocalizer: `pnp` gets the positions of landmarks and the pixels at which the frame
// sees them, the likeliest match first, and returns an optional pose.
template <typename Map, typename Pnp>
auto relocalize(const Map& map, pm::Descriptors descriptors,
                const std::vector<example::Pixel>& pixels, const Pnp& pnp) {
  const pm::MatchList matches = pm::match(map, descriptors);
  const std::vector<pm::Position> positions = map.positions(matches.landmarks);
  std::vector<pm::Position> world;
  std::vector<example::Pixel> seen;
  for (std::size_t i = 0; i < matches.size(); ++i) {
    if (std::isnan(positions[i][0])) continue;  // a landmark without a position
    world.push_back(positions[i]);
    seen.push_back(pixels[matches.keypoints[i]]);
  }
  return world.size() < 6 ? decltype(pnp(world, seen))() : pnp(world, seen);
}

bool run(const std::shared_ptr<const pm::Encoder>& encoder, const std::filesystem::path& folder) {
  example::World world(2000, encoder->bytes());
  pm::PrototypeMap map(encoder);
  example::map_world(world, map);
  map.seal(folder / "relocalize.pmk", {.bytes_per_landmark = 33});
  const pm::SealedMap sealed(folder / "relocalize.pmk");

  double worst = 0;
  for (const double x : {0.2, 6.6, 13.1, 19.7}) {
    const example::Frame frame = world.frame(x);
    const auto found = relocalize(sealed, frame.descriptors(), frame.pixels, example::pnp);
    worst = std::max(worst, found ? std::hypot((*found)[0] - x, (*found)[1], (*found)[2]) : 1e9);
  }
  // Of another place no pose is found.
  const example::Frame other = example::World(2000, encoder->bytes(), /*seed=*/1).frame(10);
  const bool none = !relocalize(sealed, other.descriptors(), other.pixels, example::pnp);
  std::printf("4 frames within %.1f cm; of another place: %s\n", 100 * worst,
              none ? "no pose" : "a wrong pose");
  return worst < 0.05 && none;
}

int main(int argc, char** argv) { return example::main(argc, argv, run); }
