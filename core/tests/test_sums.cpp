// Sums of every count in memory and in files, while rows come, change, move and go.
#include <map>
#include <numeric>
#include <utility>

#include "base/quantize.h"
#include "check.h"
#include "counted_memory.h"
#include "map/prototype_store.h"
#include "random.h"
#include "store_rows.h"

using namespace protomark;

namespace {

Sum random_sum(test::Random& random, int n, std::size_t dim) {
  Sum sum{};
  const std::int64_t most = 127 * n, kind = random.integer(0, 3);
  for (std::size_t d = 0; d < dim; ++d) {
    sum[d] = static_cast<std::int16_t>(kind == 0   ? most * random.integer(-1, 1)
                                       : kind == 1 ? random.integer(-n, n)
                                                   : random.integer(-most, most));
  }
  return sum;
}

bool equal(const Sum& a, const Sum& b, std::size_t dim) {
  return std::equal(a.begin(), a.begin() + dim, b.begin());
}

void test_counts(std::size_t dim) {
  test::Random random(static_cast<std::uint32_t>(dim));
  PrototypeStore store(dim, 0);
  bool kept = true, rounded = true;
  std::vector<std::int8_t> means(dim);
  for (int round = 0; round < 10; ++round) {
    for (int n = 1; n <= 255; ++n) {
      // Up and down between counts, or in order.
      const int count = round % 2 == 0 ? n : static_cast<int>(random.integer(1, 255));
      const Sum sum = random_sum(random, count, dim);
      const Row row = test::find_or_create_row(store, random.integer(0, 40), 0);
      store.set(row, sum, count);
      kept = kept && store.count(row) == count && equal(store.sum(row), sum, dim);
      store.rounded(row, means.data());
      for (std::size_t d = 0; d < dim; ++d) {
        rounded = rounded && means[d] == rounded_mean<int>(sum[d], count);
      }
    }
  }
  CHECK(kept && rounded);
}

// Against a plain map of sums by id and appearance.
void test_changes(std::size_t appearance_bits) {
  constexpr std::size_t kDim = 12;
  constexpr int kRounds = 6;
  test::Random random(3);
  PrototypeStore store(kDim, appearance_bits);
  std::map<std::pair<std::int64_t, std::uint16_t>, std::pair<Sum, int>> plain;
  const auto equals_plain = [&](const PrototypeStore& s) {
    bool same = s.prototype_count() == plain.size();
    for (const auto& [key, value] : plain) {
      const LandmarkIndex landmark = s.find(key.first);
      const Row row = landmark == kNoLandmark ? kNoRow : s.find_row(landmark, key.second);
      same = same && row != kNoRow && s.count(row) == value.second &&
             equal(s.sum(row), value.first, kDim);
    }
    return same;
  };
  for (int round = 0; round < kRounds; ++round) {
    for (int i = 0; i < 3000; ++i) {
      const std::int64_t id = random.integer(0, 399);
      const auto appearance =
          static_cast<std::uint16_t>(random.integer(0, (1 << appearance_bits) - 1));
      const int n = static_cast<int>(random.integer(1, i % 2 == 0 ? 20 : 255));
      if (random.integer(0, 3) == 0 && store.find(id) != kNoLandmark) {
        store.erase(id);
        std::erase_if(plain, [&](const auto& row) { return row.first.first == id; });
      } else {
        const Sum sum = random_sum(random, n, kDim);
        store.set(test::find_or_create_row(store, id, appearance), sum, n);
        plain[{id, appearance}] = {sum, n};
      }
    }
    store.reassign(1);
    CHECK(equals_plain(store));
    // A copy holds sums of its own.
    PrototypeStore copy = store;
    copy.erase(copy.id(copy.sorted_landmarks()[0]));
    for (std::int64_t id = 1000; id < 1300; ++id) {
      copy.set(test::find_or_create_row(copy, id, 0), random_sum(random, 99, kDim), 99);
    }
    CHECK(equals_plain(store));
    // Rows move into other lists.
    FairSharedMutex nobody_searches;
    Matrix<std::int8_t> centroids(static_cast<std::size_t>(random.integer(2, 9)), kDim);
    centroids.data = random.integers<std::int8_t>(centroids.data.size(), -127, 127);
    auto arrangement = store.arrange(CoarseQuantizer(centroids), 1);
    store.make_room_for(arrangement, nobody_searches);
    store.rearrange(arrangement);
    CHECK(equals_plain(store));
  }
}

// Where memory runs out nothing has changed, and a new row needs none.
void test_no_memory() {
  constexpr std::size_t kDim = 12;
  test::Random random(4);
  PrototypeStore store(kDim, 0);
  int failed = 0;
  bool kept = true;
  for (std::int64_t id = 0; id < 3000; id += 3) {
    const Sum few = random_sum(random, 15, kDim), many = random_sum(random, 16, kDim);
    std::vector<Row> rows;
    for (int i = 0; i < 3; ++i) rows.push_back(test::find_or_create_row(store, id + i, 0));
    test::left = 0;
    store.set(rows[0], many, 16);
    for (const Row row : {rows[1], rows[2]}) {
      store.set(row, few, 15);
      try {
        store.set(row, many, 16);
        kept = kept && equal(store.sum(row), many, kDim);
      } catch (const std::bad_alloc&) {
        ++failed;
        test::left = 0;
        kept = kept && store.count(row) == 15 && equal(store.sum(row), few, kDim);
      }
    }
    test::left = -1;
  }
  CHECK(kept && failed > 0);
  // What was given back is taken again.
  for (std::int64_t id = 0; id < 3000; ++id) {
    const Row row = test::find_or_create_row(store, id, 0);
    store.set(row, random_sum(random, 16, kDim), 16);
    store.set(row, random_sum(random, 1, kDim), 1);
    test::left = 0;
    store.set(row, random_sum(random, 255, kDim), 255);
    test::left = -1;
  }
}

}  // namespace

int main() {
  for (const std::size_t dim : {1, 4, 5, 8, 12, 33, 48, 64, 256}) test_counts(dim);
  for (const std::size_t appearance_bits : {0, 3}) test_changes(appearance_bits);
  test_no_memory();
  return check::result();
}
