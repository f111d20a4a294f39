// Several searchers and one writer: every answer is that of the map between two changes.
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <filesystem>
#include <numeric>
#include <stop_token>
#include <thread>

#include "check.h"
#include "protomark/protomark.h"
#include "random.h"

using namespace protomark;
namespace fs = std::filesystem;

namespace {

constexpr std::size_t kDim = 12, kNeighbours = 3, kQueries = 40;
constexpr int kRounds = 30;

using Answer = Matches;

struct Observations {
  std::vector<std::int64_t> ids;
  std::vector<std::int8_t> codes;
  Codes view() const { return {codes.data(), ids.size(), kDim}; }
};

Observations observations(test::Random& random, std::size_t n, std::int64_t first_id) {
  return {random.integers<std::int64_t>(n, first_id, first_id + 199),
          random.integers<std::int8_t>(n * kDim, -127, 127)};
}

template <typename Map>
Answer ask(const Map& map, Codes queries, int threads) {
  SearchOptions options;
  options.threads = threads;
  return map.search_codes(queries, kNeighbours, options);
}

// Changes that lead from the first state through others and back to it.
class Cycle {
 public:
  static constexpr std::size_t kSteps = 5;

  explicit Cycle(std::uint32_t seed) {
    test::Random random(seed);
    first_ = observations(random, 1500, 0);
    more_ = observations(random, 700, 100);
    passing_ = observations(random, 200, 1000);
    std::iota(passing_.ids.begin(), passing_.ids.end(), 1000);
    into_.assign(passing_.ids.begin(), passing_.ids.begin() + 100);
    source_.assign(passing_.ids.begin() + 100, passing_.ids.end());
  }

  void start(PrototypeMap& map) const { map.add_codes(first_.ids, first_.view()); }

  void step(PrototypeMap& map, std::size_t i) const {
    switch (i % kSteps) {
      case 0:
        return map.add_codes(more_.ids, more_.view());
      case 1:
        return map.add_codes(passing_.ids, passing_.view());
      case 2:
        return map.merge_landmarks(into_, source_);
      case 3:
        return map.remove(into_);
      default:
        return map.subtract_codes(more_.ids, more_.view());
    }
  }

 private:
  Observations first_, more_, passing_;
  std::vector<std::int64_t> into_, source_;
};

// All states of a map that goes through the cycle, observed from one thread.
struct States {
  States(const Cycle& cycle, Codes queries, PrototypeMap map) {
    cycle.start(map);
    for (std::size_t i = 0; i < Cycle::kSteps; ++i) {
      answers.push_back(ask(map, queries, 1));
      sizes.push_back(map.size());
      cycle.step(map, i);
    }
    CHECK(ask(map, queries, 1) == answers.front());
  }
  bool has(const Answer& answer) const {
    return std::ranges::find(answers, answer) != answers.end();
  }
  bool has(std::size_t size) const { return std::ranges::find(sizes, size) != sizes.end(); }

  std::vector<Answer> answers;
  std::vector<std::size_t> sizes;
};

void test_searches_while_a_writer_changes(std::size_t appearance_bits, const fs::path& folder) {
  const auto encoder = test::random_encoder();
  const Cycle cycle(7);
  test::Random random(8);
  const auto codes = random.integers<std::int8_t>(kQueries * kDim, -127, 127);
  const Codes queries{codes.data(), kQueries, kDim};

  const States states(cycle, queries, PrototypeMap(encoder, kDim, appearance_bits));

  // Another path, as no map may be saved over commits.
  const fs::path journaled = folder / ("journaled" + std::to_string(appearance_bits) + ".pmk");
  {
    PrototypeMap first(encoder, kDim, appearance_bits);
    cycle.start(first);
    first.save(journaled);
  }
  PrototypeMap shared = PrototypeMap::load(journaled, true);
  std::atomic<int> wrong = 0, searches = 0, files = 0, commits = 0, read = 0;
  const auto search = [&](const std::stop_token& stop, int threads) {
    while (!stop.stop_requested()) {
      wrong += states.has(ask(shared, queries, threads)) ? 0 : 1;
      wrong += states.has(shared.size()) ? 0 : 1;
      ++searches;
    }
  };
  const auto write_and_read = [&](const std::stop_token& stop) {
    const fs::path open = folder / "shared.pmk", sealed = folder / "shared.sealed.pmk";
    const std::int64_t id = shared.ids().front();
    while (!stop.stop_requested()) {
      shared.save(open);
      wrong += states.has(ask(PrototypeMap::load(open), queries, 1)) ? 0 : 1;
      shared.seal(sealed);
      wrong += states.has(ask(SealedMap(sealed), queries, 1)) ? 0 : 1;
      shared.prototypes(std::span(&id, 1));
      shared.appearances(id);
      shared.positions(std::span(&id, 1));
      shared.counts(std::span(&id, 1));
      ++files;
    }
  };
  const auto commit = [&](const std::stop_token& stop) {
    for (; !stop.stop_requested(); ++commits)
      commits % 8 == 7 ? shared.compact() : void(shared.commit());
  };
  const auto read_what_is_committed = [&](const std::stop_token& stop) {
    for (; !stop.stop_requested(); ++read) {
      wrong += states.has(ask(PrototypeMap::load(journaled), queries, 1)) ? 0 : 1;
    }
  };
  {
    std::vector<std::jthread> readers;
    for (const int threads : {1, 1, 2}) {
      readers.emplace_back([&, threads](const std::stop_token& s) { search(s, threads); });
    }
    readers.emplace_back(write_and_read);
    readers.emplace_back(commit);
    readers.emplace_back(read_what_is_committed);
    for (std::size_t i = 0; i < kRounds * Cycle::kSteps; ++i) cycle.step(shared, i);
    while (searches == 0 || files == 0 || commits == 0 || read == 0) std::this_thread::yield();
  }
  CHECK(wrong == 0);
  CHECK(ask(shared, queries, 1) == states.answers.front());
  shared.commit();
  CHECK(ask(PrototypeMap::load(journaled), queries, 1) == states.answers.front());
  std::printf(
      "appearance_bits %zu: %d searches, %d files, %d commits, %d opened during %zu changes\n",
      appearance_bits, searches.load(), files.load(), commits.load(), read.load(),
      kRounds * Cycle::kSteps);
}

// Two maps that are merged into each other at the same time.
void test_merges_of_each_other() {
  const auto encoder = test::random_encoder();
  test::Random random(9);
  const Observations a = observations(random, 300, 0), b = observations(random, 300, 1000);
  for (int round = 0; round < 20; ++round) {
    PrototypeMap left(encoder), right(encoder);
    left.add_codes(a.ids, a.view());
    right.add_codes(b.ids, b.view());
    {
      const std::jthread one([&] { left.merge_map(right); });
      const std::jthread other([&] { right.merge_map(left); });
    }
    CHECK(left.size() == right.size());
  }
}

// A merge comes to an end while both maps are searched all the time.
void test_merges_while_both_are_searched() {
  const auto encoder = test::random_encoder();
  test::Random random(10);
  const Observations a = observations(random, 3000, 0), b = observations(random, 3000, 1000);
  const auto codes = random.integers<std::int8_t>(kQueries * kDim, -127, 127);
  PrototypeMap left(encoder), right(encoder);
  left.add_codes(a.ids, a.view());
  right.add_codes(b.ids, b.view());
  std::vector<std::jthread> searchers;
  for (const PrototypeMap* map : {&left, &left, &right, &right}) {
    searchers.emplace_back([&, map](const std::stop_token& stop) {
      while (!stop.stop_requested()) ask(*map, {codes.data(), kQueries, kDim}, 1);
    });
  }
  for (int round = 0; round < 20; ++round) left.merge_map(right);
  CHECK(left.size() == 200 + right.size());
}

// Searches see a change of more than a piece (MapChange::kPiece) piece by piece, files see it
// whole.
void test_large_changes_show_in_pieces(const fs::path& folder) {
  constexpr std::size_t kPiece = 2048, kAll = 9 * kPiece + 1000;
  const auto encoder = test::random_encoder();
  std::vector<std::int64_t> ids(kAll);
  std::iota(ids.begin(), ids.end(), 1);
  test::Random random(11);
  const auto codes = random.integers<std::int8_t>(kAll * kDim, -127, 127);
  const auto descriptors = random.integers<std::uint8_t>(kAll * encoder->bytes(), 0, 255);
  const std::vector<Position> positions(kAll, Position{1, 2, 3});
  PrototypeMap map(encoder);
  const std::int64_t first = 0;
  map.add_codes(std::span(&first, 1), {codes.data(), 1, kDim});
  std::atomic<int> wrong = 0, files = 0;
  {
    const std::jthread reader([&](const std::stop_token& stop) {
      while (!stop.stop_requested()) {
        const std::size_t n = map.size() - 1;
        wrong += n % kPiece == 0 || n == kAll || (kAll - n) % kPiece == 0 ? 0 : 1;
      }
    });
    const std::jthread saver([&](const std::stop_token& stop) {
      while (!stop.stop_requested()) {
        map.save(folder / "pieces.pmk");
        const std::size_t n = PrototypeMap::load(folder / "pieces.pmk").size() - 1;
        wrong += n == 0 || n == kAll ? 0 : 1;
        ++files;
      }
    });
    for (int round = 0; round < 20 || files < 3; ++round) {
      if (round % 2 == 0) {
        map.add_codes(ids, {codes.data(), kAll, kDim});
      } else {
        map.add(ids, {descriptors.data(), kAll, encoder->bytes()}, 2);
      }
      map.set_positions(ids, positions);
      map.remove(ids);
    }
  }
  CHECK(wrong == 0);
}

// Building and dropping an index does not change exact answers, and approximate ones use the recall
// table of the present lists.
void test_searches_while_an_index_is_built() {
  const auto encoder = test::random_encoder();
  test::Random random(12);
  const Observations some = observations(random, 2000, 0);
  const auto codes = random.integers<std::int8_t>(kQueries * kDim, -127, 127);
  const Codes queries{codes.data(), kQueries, kDim};
  PrototypeMap map(encoder);
  map.add_codes(some.ids, some.view());
  const Answer exact = ask(map, queries, 1);
  std::atomic<int> wrong = 0, searches = 0;
  {
    std::vector<std::jthread> readers;
    readers.emplace_back([&](const std::stop_token& stop) {
      while (!stop.stop_requested()) wrong += ask(map, queries, 1) == exact ? 0 : 1;
    });
    for (int i = 0; i < 2; ++i) {
      readers.emplace_back([&](const std::stop_token& stop) {
        SearchOptions options;
        options.recall = 1;
        while (!stop.stop_requested()) {
          try {
            wrong += map.search_codes(queries, kNeighbours, options) == exact ? 0 : 1;
            wrong += map.nprobe(0.9) <= 16 ? 0 : 1;
          } catch (const std::invalid_argument&) {
            continue;  // there is no index now
          }
          ++searches;
        }
      });
    }
    for (int round = 0; round < 20 || searches < 100; ++round) {
      map.build_index({static_cast<std::size_t>(4 + round % 13), round % 2 == 1});
      map.add_codes(some.ids, some.view());
      map.subtract_codes(some.ids, some.view());
      if (round % 4 == 3) map.drop_index();
    }
  }
  CHECK(wrong == 0);
}

}  // namespace

int main() {
  const fs::path folder =
      fs::temp_directory_path() / ("protomark_concurrency_" + std::to_string(::getpid()));
  fs::create_directory(folder);
  for (const std::size_t appearance_bits : {0, 3}) {
    test_searches_while_a_writer_changes(appearance_bits, folder);
  }
  test_merges_of_each_other();
  test_merges_while_both_are_searched();
  test_large_changes_show_in_pieces(folder);
  test_searches_while_an_index_is_built();
  fs::remove_all(folder);
  return check::result();
}
