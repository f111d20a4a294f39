#include "protomark/protomark.h"

#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <thread>

#include "check.h"
#include "random.h"

using namespace protomark;

int main() {
  const auto encoder = test::random_encoder();
  const std::size_t n = 2000, dim = 12;
  test::Random random(4);
  const auto ids = random.integers<std::int64_t>(n, 0, 99);
  const auto codes = random.integers<std::int8_t>(n * dim, -127, 127);
  const Codes all{codes.data(), n, dim};

  PrototypeMap map(encoder);
  map.add_codes(ids, all);
  CHECK(map.size() == 100);

  // Eq. 1, one landmark at a time.
  for (const std::int64_t id : map.ids()) {
    std::vector<int> sum(dim, 0);
    unsigned count = 0;
    for (std::size_t i = 0; i < n; ++i) {
      if (ids[i] != id) continue;
      ++count;
      for (std::size_t d = 0; d < dim; ++d) sum[d] += all.row(i)[d];
    }
    const Matrix<float> mean = map.prototypes(std::span(&id, 1));
    CHECK(map.counts(std::span(&id, 1))[0] == count);
    for (std::size_t d = 0; d < dim; ++d) {
      CHECK(mean.row(0)[d] == static_cast<float>(sum[d]) / static_cast<float>(count));
    }
  }

  // Changes and searches from several threads; sums do not depend on their order.
  PrototypeMap shared(encoder);
  {
    std::vector<std::jthread> threads;
    for (std::size_t t = 0; t < 4; ++t) {
      threads.emplace_back([&, t] {
        for (std::size_t i = t; i < n; i += 4) {
          shared.add_codes(std::span(&ids[i], 1), {all.row(i), 1, dim});
          if (i % 100 == 0) {
            CHECK(shared.search_codes({all.row(i), 1, dim}, 1).ids.data[0] >= 0);
          }
        }
      });
    }
  }
  CHECK(map.prototypes(map.ids()) == shared.prototypes(map.ids()));

  // Codes at their limit, more than a count holds: the mean stays where it is, and files are valid.
  for (const int value : {127, -127}) {
    for (const std::size_t times : {255, 256, 384, 1000}) {
      const std::vector<std::int64_t> same(times, 7);
      const std::vector<std::int8_t> extreme(times * dim, static_cast<std::int8_t>(value));
      PrototypeMap full(encoder), twice(encoder);
      full.add_codes(same, {extreme.data(), times, dim});
      twice.add_codes(same, {extreme.data(), times, dim});
      twice.merge_map(full);
      for (const PrototypeMap* one : {&full, &twice}) {
        const Matrix<float> mean = one->prototypes(std::span(&same[0], 1));
        CHECK(mean.data == std::vector<float>(dim, static_cast<float>(value)));
        const auto file = std::filesystem::temp_directory_path() /
                          ("protomark_extreme_" + std::to_string(::getpid()) + ".pmk");
        one->save(file);
        CHECK(PrototypeMap::load(file).size() == 1);
        std::filesystem::remove(file);
      }
    }
  }

  map.subtract_codes(ids, all);
  CHECK(map.size() == 0);
  const std::int64_t unknown = 5;
  CHECK(check::throws<UnknownLandmark>([&] { map.remove(std::span(&unknown, 1)); }, "landmark 5"));
  return check::result();
}
