// The steps of a commit and a compaction: their order, each one failing, and a killed process or
// power cut at each moment.
#include <cerrno>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <future>
#include <iterator>
#include <map>
#include <optional>
#include <set>
#include <utility>

#include "check.h"
#include "faulty_disk.h"
#include "protomark/protomark.h"
#include "random.h"

namespace fs = std::filesystem;

using namespace protomark;

namespace {

using Content = std::vector<char>;

const fs::path folder =
    fs::temp_directory_path() / ("protomark_journal_" + std::to_string(::getpid()));
const fs::path path = folder / "disk" / "map.pmk";

Content read(const fs::path& file) {
  std::ifstream in(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

// The map files and journals that a disk may have after a power cut: all that was synced, and any
// part of the rest. A killed process leaves the present names and contents.
class PowerCuts {
 public:
  using World = std::map<std::string, Content>;

  // The present content is synced.
  PowerCuts() {
    observe();
    synced_names_ = names_;
    synced_ = current_;
    worlds_.clear();
    disk.before_step = [this] { observe(); };
    disk.after_sync = [this](int descriptor, bool of_folder) {
      observe();
      struct stat status;
      ::fstat(descriptor, &status);
      if (of_folder) synced_names_ = names_;
      if (!of_folder) synced_[status.st_ino] = current_[status.st_ino];
    };
  }
  ~PowerCuts() { disk = {}; }
  PowerCuts(const PowerCuts&) = delete;
  PowerCuts& operator=(const PowerCuts&) = delete;

  // Those that are possible since the last call.
  std::set<World> take() {
    observe();
    return std::exchange(worlds_, {});
  }

 private:
  using Names = std::map<std::string, ino_t>;

  void observe() {
    names_.clear();
    for (const auto& entry : fs::directory_iterator(path.parent_path())) {
      struct stat status;
      ::stat(entry.path().c_str(), &status);
      names_[entry.path().filename()] = status.st_ino;
      current_[status.st_ino] = read(entry.path());
    }
    for (const Names& names : {names_, synced_names_}) {
      std::vector<World> some(1);
      for (const auto& [name, inode] : names) {
        if (name != "map.pmk" && name != "map.pmk.journal") continue;
        std::vector<World> more;
        for (const World& world : some) {
          for (const Content& content : contents(inode)) {
            more.push_back(world);
            more.back()[name] = content;
          }
        }
        some = std::move(more);
      }
      worlds_.insert(some.begin(), some.end());
    }
  }

  std::set<Content> contents(ino_t inode) {
    const Content &now = current_[inode], &synced = synced_[inode];
    // The size reached the disk, the content did not.
    Content zeros = now;
    for (std::size_t i = synced.size(); i < zeros.size(); ++i) zeros[i] = 0;
    return {now, synced, zeros};
  }

  Names names_, synced_names_;
  std::map<ino_t, Content> current_, synced_;
  std::set<World> worlds_;
};

void add(PrototypeMap& map, std::uint32_t seed, std::int64_t first, std::size_t n) {
  test::Random random(seed);
  const auto codes = random.integers<std::int8_t>(n * 12, -127, 127);
  const auto ids = random.integers<std::int64_t>(n, first, first + 20);
  map.add_codes(ids, {codes.data(), n, 12});
}

Content bytes_of(const PrototypeMap& map) {
  map.save(folder / "scratch.pmk");
  return read(folder / "scratch.pmk");
}

// A map file, commits to it, and uncommitted changes.
struct Session {
  Session() {
    fs::remove_all(path.parent_path());
    fs::create_directories(path.parent_path());
    PrototypeMap first(test::random_encoder(), 0, 2);
    add(first, 1, 0, 30);
    first.save(path);
    map.emplace(PrototypeMap::load(path, true));
    add(*map, 2, 10, 10);
    map->commit();
    map->remove(std::vector<std::int64_t>{map->ids().front()});
    map->build_index({3});
    CHECK(map->commit() > 0);
    committed = bytes_of(*map);
    add(*map, 3, 100, 10);
    map->merge_landmarks(std::vector{map->ids()[1]}, std::vector{map->ids()[2]});
    changed = bytes_of(*map);
    CHECK(committed != changed);
  }

  std::optional<PrototypeMap> map;
  Content committed, changed;
};

using Action = void (*)(PrototypeMap&);
void commit(PrototypeMap& map) { map.commit(); }
void compact(PrototypeMap& map) { map.compact(); }

// An opened map is one of these and can be changed and committed.
void check_world(const PowerCuts::World& world, const std::set<Content>& states) {
  const fs::path there = folder / "world";
  fs::remove_all(there);
  fs::create_directory(there);
  for (const auto& [name, content] : world) {
    std::ofstream(there / name, std::ios::binary)
        .write(content.data(), static_cast<std::streamsize>(content.size()));
  }
  try {
    CHECK(states.contains(bytes_of(PrototypeMap::load(there / "map.pmk"))));
    PrototypeMap map = PrototypeMap::load(there / "map.pmk", true);
    CHECK(states.contains(bytes_of(map)));
    add(map, 9, 0, 5);
    map.commit();
    verify_file(there / "map.pmk");
    CHECK(bytes_of(PrototypeMap::load(there / "map.pmk")) == bytes_of(map));
  } catch (const std::exception& error) {
    std::printf("%s\n", error.what());
    CHECK(!"it opens");
  }
}

std::size_t files_beside() {
  return static_cast<std::size_t>(std::distance(fs::directory_iterator(path.parent_path()), {}));
}

void power_cuts(Action action) {
  Session session;
  std::set<PowerCuts::World> during, after;
  {
    PowerCuts cuts;
    action(*session.map);
    during = cuts.take();
    after = cuts.take();
  }
  for (const auto& world : during) check_world(world, {session.committed, session.changed});
  for (const auto& world : after) check_world(world, {session.changed});
  std::printf("%zu states of the disk, %zu when it had returned\n", during.size(), after.size());
  CHECK(during.size() > 3);
}

// If the journal could not be emptied, the map file and later commits count.
void power_cuts_after_a_failure() {
  for (long step = 4; step > 0; --step) {
    long all = 0;
    {
      Session session;
      disk = {};
      compact(*session.map);
      all = disk.steps;
    }
    Session other;
    disk = {};
    disk.fails_at = all - step;
    disk.broken = true;
    compact(*other.map);
    disk = {};
    add(*other.map, 6, 50, 10);
    const Content next = bytes_of(*other.map);
    std::set<PowerCuts::World> before, during, after;
    {
      PowerCuts cuts;
      before = cuts.take();
      commit(*other.map);
      during = cuts.take();
      after = cuts.take();
    }
    for (const auto& world : before) check_world(world, {other.changed});
    for (const auto& world : during) check_world(world, {other.changed, next});
    for (const auto& world : after) check_world(world, {next});
  }
}

// Another map opens the journal after `save` onto its file has begun: its commits are not lost, be
// the journal open or closed by then.
void journal_begun_while_saving() {
  for (const bool sealed : {false, true}) {
    for (const bool closed : {false, true}) {
      Session session;
      session.map->compact();
      session.map->close();
      fs::remove(path.string() + ".journal");
      PrototypeMap other(test::random_encoder(), 0, 2);
      add(other, 7, 0, 30);
      std::optional<PrototypeMap> late;
      Content committed;
      disk = {};
      bool begun = false;
      disk.before_step = [&] {
        if (std::exchange(begun, true)) return;
        late.emplace(PrototypeMap::load(path, true));
        add(*late, 8, 40, 5);
        late->commit();
        committed = bytes_of(*late);
        if (closed) late->close();
      };
      const std::string why =
          closed ? "its journal holds 1 commits" : "its journal is held by another map";
      CHECK(check::throws<FileError>([&] { sealed ? other.seal(path) : other.save(path); }, why));
      disk = {};
      CHECK(late && bytes_of(PrototypeMap::load(path)) == committed);
      CHECK(files_beside() == 2);
    }
  }
}

// Opening begins a journal, cuts a torn one, or begins it anew behind another map file.
void power_cuts_at_opening() {
  Session session;
  session.map->close();
  for (const int kind : {0, 1, 2}) {
    const fs::path journal = path.string() + ".journal";
    if (kind == 0) {
      std::ofstream(journal, std::ios::binary | std::ios::app) << std::string(100, 'x');
    } else if (kind == 1) {
      fs::remove(journal);
      std::ofstream(path, std::ios::binary)
          .write(session.committed.data(), static_cast<std::streamsize>(session.committed.size()));
    } else {
      std::ofstream(path, std::ios::binary)
          .write(session.changed.data(), static_cast<std::streamsize>(session.changed.size()));
    }
    std::set<PowerCuts::World> worlds;
    {
      PowerCuts cuts;
      const PrototypeMap map = PrototypeMap::load(path, true);
      worlds = cuts.take();
    }
    CHECK(worlds.size() > 1);
    for (const auto& world : worlds) {
      check_world(world, {kind == 2 ? session.changed : session.committed});
    }
  }
}

// The last `quiet` steps only empty the journal: a compaction that fails there has been made.
void failing_steps(Action action, long quiet) {
  long steps = 0, all = 0;
  {
    Session session;
    disk = {};
    action(*session.map);
    all = disk.steps;
  }
  for (bool done = false; !done; ++steps) {
    for (const bool broken : {false, true}) {
      for (const int error : {EIO, ENOSPC}) {
        Session session;
        disk = {};
        disk.fails_at = steps;
        disk.broken = broken;
        disk.error = error;
        bool threw = false;
        try {
          action(*session.map);
        } catch (const FileError& e) {
          threw = true;
          CHECK(std::string(e.what()).find(std::strerror(error)) != std::string::npos);
        }
        done = disk.steps <= steps;
        CHECK(done == (steps >= all));
        CHECK(threw == (steps < all - quiet));
        disk = {};
        const Content there = bytes_of(PrototypeMap::load(path));
        CHECK(there == session.changed || (threw && there == session.committed));
        if (quiet != 0 && !threw) {
          CHECK(read(path) == session.changed);
          const auto left = file_journal(path);
          CHECK(!left || left->commits == 0);
          CHECK(session.map->commit() == 0);
        }
        CHECK(bytes_of(*session.map) == session.changed);
        // The failed step may be tried again, in any way.
        if (broken) compact(*session.map);
        session.map->commit();
        CHECK(bytes_of(PrototypeMap::load(path)) == session.changed);
        add(*session.map, 5, 0, 20);
        CHECK(session.map->commit() > 0);
        const Content last = bytes_of(*session.map);
        CHECK(bytes_of(PrototypeMap::load(path)) == last);
        session.map->close();
        CHECK(bytes_of(PrototypeMap::load(path, true)) == last);
      }
    }
  }
  std::printf("%ld steps that fail\n", steps - 1);
}

// A map is saved to another file while it is being compacted.
void saved_while_compacting() {
  Session session;
  std::future<void> saved;
  disk = {};
  disk.before_step = [&] {
    disk.before_step = {};
    saved = std::async(std::launch::async, [&] { session.map->save(folder / "other.pmk"); });
    CHECK(saved.wait_for(std::chrono::seconds(30)) == std::future_status::ready);
  };
  session.map->compact();
  saved.get();
  CHECK(read(folder / "other.pmk") == session.changed && read(path) == session.changed);
  disk = {};
}

void order_of_steps() {
  using Calls = std::vector<std::string>;
  Session session;
  disk = {};
  session.map->commit();
  CHECK(disk.calls == Calls{"cut", "sync file"});
  disk = {};
  CHECK(session.map->commit() == 0);
  CHECK(disk.steps == 0);
  add(*session.map, 4, 0, 1);
  session.map->compact();
  CHECK(disk.calls == Calls{"sync file", "cut", "sync file", "rename", "sync folder", "cut",
                            "sync file", "sync file"});
  CHECK(session.map->commit() == 0);
  session.map->close();
  fs::remove(path.string() + ".journal");
  disk = {};
  PrototypeMap::load(path);
  CHECK(disk.steps == 0);
  PrototypeMap::load(path, true);
  // The new name is durable before the commits that the old file lacks are dropped.
  CHECK(disk.calls == Calls{"sync folder", "cut", "sync file", "sync file"});
}

}  // namespace

int main() {
  fs::create_directories(folder);
  order_of_steps();
  for (const Action action : {commit, compact}) {
    power_cuts(action);
    failing_steps(action, action == compact ? 4 : 0);
  }
  power_cuts_after_a_failure();
  power_cuts_at_opening();
  journal_begun_while_saving();
  saved_while_compacting();
  fs::remove_all(folder);
  return check::result();
}
