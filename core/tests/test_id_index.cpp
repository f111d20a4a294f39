// The index against a std::unordered_map under a long random history.
#include <unordered_map>

#include "check.h"
#include "id_index.h"
#include "random.h"

int main() {
  using protomark::IdIndex;
  protomark::test::Random random(3);
  protomark::LargeVector<std::int64_t> ids;
  IdIndex index;
  std::unordered_map<std::int64_t, std::uint32_t> expected;
  for (int step = 0; step < 200000; ++step) {
    const std::int64_t id = random.integer(0, 3000) << (step % 2 == 0 ? 0 : 40);
    const auto found = expected.find(id);
    CHECK(index.find(ids, id) == (found == expected.end() ? IdIndex::kNone : found->second));
    if (found == expected.end()) {
      ids.push_back(id);
      index.insert(ids, static_cast<std::uint32_t>(ids.size() - 1));
      expected[id] = static_cast<std::uint32_t>(ids.size() - 1);
    } else if (random.integer(0, 2) > 0) {
      // As the map erases: the last row takes the free place.
      const std::uint32_t row = found->second;
      index.erase(ids, id);
      expected.erase(found);
      if (row != ids.size() - 1) {
        index.move(ids, ids.back(), row);
        expected[ids.back()] = row;
        ids[row] = ids.back();
      }
      ids.pop_back();
    }
    if (check::failures > 0) break;
  }
  CHECK(expected.size() > 100);
  return check::result();
}
