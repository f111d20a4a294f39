// The map file and journal that the journal tests work on.
#pragma once

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <optional>
#include <span>
#include <vector>

#include "check.h"
#include "protomark/protomark.h"
#include "random.h"

namespace fs = std::filesystem;

namespace protomark::test {

using Content = std::vector<char>;

// In memory where that is possible: thousands of maps are saved here, and each one is synced.
inline const fs::path folder =
    (fs::is_directory("/dev/shm") ? fs::path("/dev/shm") : fs::temp_directory_path()) /
    ("protomark_journal_" + std::to_string(getpid()));
inline const fs::path path = folder / "map.pmk";
inline const fs::path journal = folder / "map.pmk.journal";

inline Content read(const fs::path& file) {
  std::ifstream in(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

inline void write(const fs::path& file, const Content& content) {
  std::ofstream(file, std::ios::binary)
      .write(content.data(), static_cast<std::streamsize>(content.size()));
}

inline Content bytes_of(const PrototypeMap& map) {
  map.save(folder / "scratch.pmk");
  return read(folder / "scratch.pmk");
}

inline void begin(std::size_t appearance_bits) {
  fs::remove_all(folder);
  fs::create_directories(folder);
  PrototypeMap(test::random_encoder(), 0, appearance_bits).save(path);
}

inline void add(PrototypeMap& map, std::uint32_t seed, std::size_t n = 10) {
  test::Random random(seed);
  const auto codes = random.integers<std::int8_t>(n * 12, -127, 127);
  const auto ids = random.integers<std::int64_t>(n, 0, 30);
  map.add_codes(ids, {codes.data(), n, 12});
}

// Two commits and the lengths of the journal after each.
struct Commits {
  explicit Commits(std::size_t appearance_bits) {
    begin(appearance_bits);
    map.emplace(PrototypeMap::load(path, true));
    for (int i = 0; i < 3; ++i) {
      lengths.push_back(fs::file_size(journal));
      states.push_back(bytes_of(*map));
      add(*map, 10 + static_cast<std::uint32_t>(i));
      if (i == 1) map->remove(std::vector{map->ids()[0]});
      CHECK(map->commit() + lengths.back() == fs::file_size(journal));
    }
    lengths.push_back(fs::file_size(journal));
    states.push_back(bytes_of(*map));
    map->close();
    whole = read(journal);
    base = read(path);
  }

  Content opened(const Content& content) const {
    return bytes_of(PrototypeMap::parse(std::as_bytes(std::span(base)), "map",
                                        std::as_bytes(std::span(content))));
  }

  std::optional<PrototypeMap> map;
  std::vector<std::size_t> lengths;
  std::vector<Content> states;
  Content whole, base;
};

}  // namespace protomark::test
