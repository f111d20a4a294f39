// The index against a std::unordered_map under a long random history, and with ids that are chosen
// to be slow.
#include <unordered_map>

#include "base/id_index.h"
#include "check.h"
#include "random.h"

using protomark::IdIndex, protomark::kNoLandmark, protomark::LandmarkIndex;

namespace {

// Returns the x for which x ^ (x >> shift) is y.
std::uint64_t undo_shift(std::uint64_t y, int shift) {
  std::uint64_t x = y;
  for (int i = 0; i < 64 / shift; ++i) x = y ^ (x >> shift);
  return x;
}

// The inverse of an odd number, by Newton's method.
std::uint64_t inverse(std::uint64_t odd) {
  std::uint64_t x = odd;
  for (int i = 0; i < 6; ++i) x *= 2 - odd * x;
  return x;
}

// Ids that SplitMix64 without a seed maps to one slot of any table of up to 2^28. The test counts
// slots, not time.
void chosen_ids() {
  protomark::LargeVector<std::int64_t> ids;
  for (std::uint64_t k = 0; ids.size() < 10000; ++k) {
    std::uint64_t x = undo_shift(k << 28 | 12345, 31) * inverse(0x94d049bb133111eb);
    x = undo_shift(x, 27) * inverse(0xbf58476d1ce4e5b9);
    x = undo_shift(x, 30) - 0x9e3779b97f4a7c15;
    if (x < std::uint64_t{1} << 63) ids.push_back(static_cast<std::int64_t>(x));
  }
  IdIndex index;
  for (std::uint32_t i = 0; i < ids.size(); ++i) index.insert(ids, LandmarkIndex{i});
  std::size_t slots = 0;
  for (const std::int64_t id : ids) slots += index.probe_length(ids, id);
  CHECK(slots < 4 * ids.size());
}

}  // namespace

int main() {
  protomark::test::Random random(3);
  protomark::LargeVector<std::int64_t> ids;
  IdIndex index;
  std::unordered_map<std::int64_t, LandmarkIndex> expected;
  for (int step = 0; step < 200000; ++step) {
    const std::int64_t id = random.integer(0, 3000) << (step % 2 == 0 ? 0 : 40);
    const auto found = expected.find(id);
    CHECK(index.find(ids, id) == (found == expected.end() ? kNoLandmark : found->second));
    if (found == expected.end()) {
      ids.push_back(id);
      const LandmarkIndex last{static_cast<std::uint32_t>(ids.size() - 1)};
      index.insert(ids, last);
      expected[id] = last;
    } else if (random.integer(0, 2) > 0) {
      // As the map erases: the last landmark takes the free index.
      const LandmarkIndex landmark = found->second;
      index.erase(ids, id);
      expected.erase(found);
      if (landmark.value != ids.size() - 1) {
        index.move(ids, ids.back(), landmark);
        expected[ids.back()] = landmark;
        ids[landmark.value] = ids.back();
      }
      ids.pop_back();
    }
    if (check::failures > 0) break;
  }
  CHECK(expected.size() > 100);
  chosen_ids();
  return check::result();
}
