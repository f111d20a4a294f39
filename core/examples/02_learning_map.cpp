// A map that learns frame by frame, as in SLAM: match the frame, add what it saw, commit.
//
//   02_learning_map MODEL.pme FOLDER
#include "world.h"

bool run(const std::shared_ptr<const pm::Encoder>& encoder, const std::filesystem::path& folder) {
  example::World world(2000, encoder->bytes());
  const std::filesystem::path path = folder / "learning.pmk";
  pm::PrototypeMap(encoder).save(path);
  // Each commit is durable, and costs what changed.
  pm::PrototypeMap map = pm::PrototypeMap::load(path, /*journal=*/true);
  std::int64_t next = 0;                  // id of the next new landmark
  std::vector<std::int64_t> landmark_of;  // the world's landmark that one of the map is

  std::size_t matched = 0, right = 0;
  for (int i = 0; i <= 40; ++i) {
    const example::Frame frame = world.frame(0.5 * i);
    // Stricter than by default, as a wrong observation would stay in its landmark.
    const pm::MatchList matches = pm::match(map, frame.descriptors(), {.min_probability = 0.5});

    // A matched keypoint is one more observation of its landmark, any other a new landmark. Yours
    // would be those that agree with the frame's pose, and those that can be triangulated.
    std::vector<std::int64_t> ids(frame.size(), -1), fresh, seen;
    for (std::size_t m = 0; m < matches.size(); ++m) {
      ids[matches.keypoints[m]] = matches.landmarks[m];
      const auto landmark = static_cast<std::size_t>(matches.landmarks[m]);
      right += landmark_of[landmark] == frame.truth[matches.keypoints[m]];
    }
    matched += matches.size();
    for (std::size_t k = 0; k < frame.size(); ++k) {
      if (ids[k] >= 0) continue;
      fresh.push_back(ids[k] = next++);
      landmark_of.push_back(frame.truth[k]);
      seen.push_back(frame.truth[k]);
    }
    map.add(ids, frame.descriptors());  // the descriptors are not kept
    map.set_positions(fresh, world.positions(seen));
    map.commit();
  }
  map.compact();
  std::printf("41 frames: %zu landmarks, %zu of %zu matches right\n", map.size(), right, matched);
  return right > 0.99 * matched && map.size() < 1.1 * world.size() &&
         pm::PrototypeMap::load(path).ids() == map.ids();
}

int main(int argc, char** argv) { return example::main(argc, argv, run); }
