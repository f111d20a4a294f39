// Journals: an opened map has all commits, whatever others do meanwhile.
#include <fcntl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cmath>
#include <cstdarg>
#include <cstring>
#include <functional>
#include <utility>

#include "file/container.h"
#include "file/journal.h"
#include "journal_files.h"
#include "map/map_state.h"

using namespace protomark;
using namespace protomark::test;

namespace {
// Runs before a file is opened.
std::function<void(const std::string&)> before_open;
}  // namespace

extern "C" int open(const char* file, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  const mode_t mode = (flags & O_CREAT) != 0 ? va_arg(rest, mode_t) : 0;
  va_end(rest);
  if (const auto hook = before_open) hook(file);
  return static_cast<int>(syscall(SYS_openat, AT_FDCWD, file, flags, mode));
}

namespace {

// Any change of a map.
void change(PrototypeMap& map, test::Random& random) {
  const auto ids = map.ids();
  const auto some_id = [&] {
    return ids[static_cast<std::size_t>(
        random.integer(0, static_cast<std::int64_t>(ids.size()) - 1))];
  };
  const auto seed = static_cast<std::uint32_t>(random.integer(0, 1 << 20));
  switch (ids.size() < 5 ? 0 : random.integer(0, 10)) {
    case 0:
      return add(map, seed, 300);  // some are halved
    case 1:
      return map.remove(std::vector{some_id()});
    case 2: {
      const auto a = some_id(), b = some_id();
      if (a != b) map.merge_landmarks(std::vector{a}, std::vector{b});
      return;
    }
    case 3: {
      const Position p = random.integer(0, 2) == 0 ? Position{NAN, NAN, NAN} : Position{1, 2, 3.5};
      return map.set_positions(std::vector{some_id()}, std::vector{p});
    }
    case 4: {
      PrototypeMap other(map.encoder(), 0, map.appearance_bits());
      add(other, seed);
      return map.merge_map(other);
    }
    case 5: {  // and what was added can be taken back
      const auto codes = random.integers<std::int8_t>(12, -127, 127);
      const std::vector<std::int64_t> id = {random.integer(0, 40)};
      map.add_codes(id, {codes.data(), 1, 12});
      return map.subtract_codes(id, {codes.data(), 1, 12});
    }
    case 6:
      return map.build_index({static_cast<std::size_t>(random.integer(1, 4))});
    case 7:
      return map.drop_index();
    case 8:
      return map.set_metadata(seed % 3 == 0 ? Metadata() : Metadata{{"n", std::to_string(seed)}});
    default:
      return add(map, seed);
  }
}

void any_history(std::size_t appearance_bits, std::uint32_t seed) {
  begin(appearance_bits);
  test::Random random(seed);
  std::optional<PrototypeMap> map(PrototypeMap::load(path, true));
  Content committed = bytes_of(*map);
  for (int step = 0; step < 150; ++step) {
    switch (random.integer(0, 9)) {
      case 0:
        map->compact();
        committed = bytes_of(*map);
        break;
      case 1:  // uncommitted changes are lost
        map.reset();
        map.emplace(PrototypeMap::load(path, true));
        CHECK(bytes_of(*map) == committed);
        break;
      case 2:
        map->save(path);
        committed = bytes_of(*map);
        break;
      case 3:
      case 4:
      case 5:
        map->commit();
        committed = bytes_of(*map);
        break;
      default:
        change(*map, random);
    }
    CHECK(bytes_of(PrototypeMap::load(path)) == committed);
  }
  verify_file(path);
}

// The journal, and the map after compacting, are only as readable as the map file was.
void permissions_of_the_map() {
  for (const auto mode : {fs::perms(0600), fs::perms(0664)}) {
    begin(0);
    fs::permissions(path, mode);
    PrototypeMap map = PrototypeMap::load(path, true);
    add(map, 1);
    map.commit();
    CHECK(fs::status(journal).permissions() == mode);
    map.compact();
    CHECK(fs::status(path).permissions() == mode && fs::status(journal).permissions() == mode);
  }
}

void other_map_files() {
  const Commits c(0);
  PrototypeMap other(test::random_encoder());
  add(other, 99);
  other.save(folder / "other.pmk");
  const auto other_bytes = read(folder / "other.pmk");
  const std::string stale = "map.pmk.journal: holds 3 commits to another map file";
  // Another file replaces the map file.
  write(path, other_bytes);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path); }, stale));
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, stale));
  CHECK(check::throws<FileError>([] { verify_file(path); }, stale));
  other.seal(folder / "sealed.pmk");
  fs::copy_file(folder / "sealed.pmk", path, fs::copy_options::overwrite_existing);
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, stale));
  // The right one is back.
  write(path, c.base);
  CHECK(bytes_of(PrototypeMap::load(path)) == c.states[3]);

  // No map is saved over commits.
  const std::string lost = "map.pmk: cannot be written: its journal holds 3 commits";
  CHECK(check::throws<FileError>([&] { other.save(path); }, lost));
  CHECK(check::throws<FileError>([&] { other.seal(path); }, lost));
  CHECK(check::throws<FileError>([&] { other.encoder()->save(path); }, lost));
  fs::create_symlink(path, folder / "other_link.pmk");
  CHECK(check::throws<FileError>([&] { other.save(folder / "other_link.pmk"); },
                                 "other_link.pmk: cannot be written: its journal holds 3 commits"));
  CHECK(read(path) == c.base && read(journal) == c.whole);
  // Nor while a map may commit.
  PrototypeMap map = PrototypeMap::load(path, true);
  const std::string held = "its journal is held by another map of this process";
  CHECK(check::throws<FileError>([&] { other.save(path); }, held));
  CHECK(check::throws<FileError>([&] { map.seal(path); }, held));
  map.save(path);
  CHECK(read(path) == c.states[3]);
  CHECK(file_journal(path)->commits == 0);
  map.close();
  other.save(path);
  CHECK(bytes_of(PrototypeMap::load(path)) == other_bytes);
  CHECK(bytes_of(PrototypeMap::load(path, true)) == other_bytes);

  // A commit notices that the map file was removed.
  PrototypeMap next = PrototypeMap::load(path, true);
  add(next, 1);
  write(path, c.base);
  CHECK(check::throws<FileError>([&] { next.commit(); }, "was replaced or deleted"));
  write(path, other_bytes);
  CHECK(next.commit() > 0);

  CHECK(
      check::throws<FileError>([] { PrototypeMap::load(folder / "none", true); }, "No such file"));
  CHECK(check::throws<FileError>([] { PrototypeMap::load(folder / "sealed.pmk", true); },
                                 "it holds a sealed map, not a learning map"));
  CHECK(!fs::exists(folder / "sealed.pmk.journal") && !fs::exists(folder / "none.journal"));
}

void one_writer() {
  begin(0);
  std::optional<PrototypeMap> map(PrototypeMap::load(path, true));
  CHECK(map->has_journal());
  const std::string held = "map.pmk.journal: is held by another map of this process";
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, held));
  fs::create_symlink(path, folder / "link.pmk");
  CHECK(check::throws<FileError>([] { PrototypeMap::load(folder / "link.pmk", true); }, held));
  add(*map, 1);
  map->commit();
  CHECK(PrototypeMap::load(path).size() == map->size());
  CHECK(PrototypeMap::load(folder / "link.pmk").size() == map->size());

  // The error tells another process which one holds the journal; a fork of this one may not commit.
  add(*map, 2);
  const pid_t child = ::fork();
  if (child == 0) {
    const bool copy = check::throws<FileError>([&] { map->commit(); }, "(fork)");
    const bool other =
        check::throws<FileError>([] { PrototypeMap::load(path, true); },
                                 "is held by process " + std::to_string(::getppid()));
    ::_exit(copy && other ? 0 : 1);
  }
  int status = -1;
  ::waitpid(child, &status, 0);
  CHECK(status == 0);
  CHECK(map->commit() > 0);

  map->close();
  CHECK(!map->has_journal());
  CHECK(check::throws<std::invalid_argument>([&] { map->commit(); }, "has no journal"));
  CHECK(check::throws<std::invalid_argument>([&] { map->compact(); }, "has no journal"));
  std::optional<PrototypeMap> next(PrototypeMap::load(path, true));
  CHECK(bytes_of(*next) == bytes_of(*map));
  PrototypeMap moved = std::move(*next);
  next.reset();
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, held));
  moved.close();
  PrototypeMap::load(path, true);
}

// A map file that is compacted twice while it is read, in the end to an equal one, whose journal is
// not that of the one in between.
void compacted_twice_meanwhile() {
  begin(0);
  PrototypeMap map = PrototypeMap::load(path, true);
  add(map, 1);
  map.compact();
  const Content expected = bytes_of(map);
  const std::vector<std::int64_t> id = {500};
  const std::vector<std::int8_t> code(12, 3);
  int maps = 0;
  bool other = false;
  before_open = [&](const std::string& file) {
    const auto hook = std::exchange(before_open, {});
    if (file == journal && !other) {
      other = true;
      map.add_codes(id, {code.data(), 1, 12});
      map.compact();
      map.set_metadata({{"n", "1"}});
      map.commit();
    } else if (file == path && ++maps == 2) {
      map.set_metadata({});
      map.remove(id);
      map.compact();
      CHECK(read(path) == expected);
    }
    before_open = hook;
  };
  CHECK(bytes_of(PrototypeMap::load(path)) == expected);
  CHECK(other && maps > 2);
  before_open = {};
}

// A map that cannot be opened gets no journal.
void nothing_is_left_behind() {
  begin(0);
  {
    PrototypeMap map = PrototypeMap::load(path);
    add(map, 1);
    map.save(path);
  }
  Content broken = read(path);
  const Bytes bytes = std::as_bytes(std::span(broken));
  const auto sums = ContainerReader(bytes, "map").map("sums").data() - bytes.data();
  broken[static_cast<std::size_t>(sums)] ^= 1;
  write(path, broken);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, "checksum"));
  CHECK(!fs::exists(journal));
  // An existing one stays.
  begin(0);
  PrototypeMap::load(path, true).close();
  const Content head = read(journal);
  write(path, broken);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, "checksum"));
  CHECK(read(journal) == head);
}

// Files made to be slow to read: landmarks with thousands of appearances, and others added and
// removed beside them. The test counts rows, not time.
void thousands_of_appearances() {
  begin(12);
  PrototypeMap map = PrototypeMap::load(path, true);
  std::vector<std::int8_t> codes;
  for (int appearance = 0; appearance < 1 << 12; ++appearance) {
    for (int d = 0; d < 12; ++d) codes.push_back((appearance >> d & 1) != 0 ? 5 : -5);
  }
  const auto grow = [&](std::int64_t id) {
    map.add_codes(std::vector<std::int64_t>(codes.size() / 12, id),
                  {codes.data(), codes.size() / 12, 12});
    map.commit();
  };
  constexpr std::int64_t kSmall = 200;
  for (std::int64_t id = kSmall; id > 0; --id) {
    map.add_codes(std::vector{id}, {codes.data(), 1, 12});
    map.commit();
  }
  for (const std::int64_t id : {1000, 1001, 1000, 1001, 999}) grow(id);
  std::vector<std::int64_t> removed;
  for (std::int64_t id = 1; id <= kSmall; ++id) removed.push_back(id);
  map.remove(removed);
  map.commit();
  grow(1000);
  const Content expected = bytes_of(map);

  const Content file_bytes = read(path), journal_bytes = read(journal);
  const ContainerReader file(std::as_bytes(std::span(file_bytes)), "map");
  const JournalContent commits(std::as_bytes(std::span(journal_bytes)), "map.journal");
  const auto state = read_map(file, commits);
  const PrototypeStore& store = state->store;
  CHECK(store.landmark_count() == 3 && store.prototype_count() == 3 * (1 << 12));
  CHECK(store.steps() <= store.prototype_count());
  map.close();
  CHECK(bytes_of(PrototypeMap::load(path)) == expected);
}

// The cost of a commit grows with the change.
void cost() {
  begin(0);
  PrototypeMap map = PrototypeMap::load(path, true);
  add(map, 1, 1000);
  map.commit();
  CHECK(map.commit() == 0);
  map.add_codes(std::vector<std::int64_t>{7}, {std::vector<std::int8_t>(12, 1).data(), 1, 12});
  CHECK(map.commit() <= 64 * 12);
  CHECK(file_journal(path)->bytes == fs::file_size(journal));
  map.save(folder / "other.pmk");
  CHECK(!file_journal(folder / "other.pmk"));
}

}  // namespace

int main() {
  for (const std::size_t appearance_bits : {0, 3}) {
    for (const std::uint32_t seed : {1, 2, 3}) any_history(appearance_bits, seed);
  }
  permissions_of_the_map();
  other_map_files();
  one_writer();
  compacted_twice_meanwhile();
  nothing_is_left_behind();
  thousands_of_appearances();
  cost();
  fs::remove_all(folder);
  return check::result();
}
