// Journals: what is committed is there when the map is opened, a broken tail is left out, and
// anything else that is wrong is refused.
#include <fcntl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdarg>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iterator>
#include <new>
#include <optional>

#include "base/crc32.h"
#include "check.h"
#include "file/container.h"
#include "file/journal.h"
#include "map/map_content.h"
#include "protomark/error.h"
#include "protomark/map_file.h"
#include "protomark/prototypes.h"
#include "random.h"

namespace fs = std::filesystem;

using namespace protomark;

namespace {
// What happens before a file is opened.
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

// A machine without memory for what no test needs. Inlined, they look mismatched to g++.
[[gnu::noinline]] void* operator new(std::size_t size) {
  void* memory = size > std::size_t{1} << 30 ? nullptr : std::malloc(size);
  return memory != nullptr ? memory : throw std::bad_alloc();
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

using Content = std::vector<char>;

// In memory where that is possible: thousands of maps are saved here, and each one is synced.
const fs::path folder =
    (fs::is_directory("/dev/shm") ? fs::path("/dev/shm") : fs::temp_directory_path()) /
    ("protomark_journal_" + std::to_string(getpid()));
const fs::path path = folder / "map.pmk";
const fs::path journal = folder / "map.pmk.journal";

Content read(const fs::path& file) {
  std::ifstream in(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

void write(const fs::path& file, const Content& content) {
  std::ofstream(file, std::ios::binary)
      .write(content.data(), static_cast<std::streamsize>(content.size()));
}

Content bytes_of(const PrototypeMap& map) {
  map.save(folder / "scratch.pmk");
  return read(folder / "scratch.pmk");
}

void begin(std::size_t look_bits) {
  fs::remove_all(folder);
  fs::create_directories(folder);
  PrototypeMap(test::random_encoder(), 0, look_bits).save(path);
}

void add(PrototypeMap& map, std::uint32_t seed, std::size_t n = 10) {
  test::Random random(seed);
  const auto codes = random.integers<std::int8_t>(n * 12, -127, 127);
  const auto ids = random.integers<std::int64_t>(n, 0, 30);
  map.add_codes(ids, {codes.data(), n, 12});
}

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
      return map.discard(std::vector{some_id()});
    case 2: {
      const auto a = some_id(), b = some_id();
      if (a != b) map.merge(std::vector{a}, std::vector{b});
      return;
    }
    case 3: {
      const Position p = random.integer(0, 2) == 0 ? Position{NAN, NAN, NAN} : Position{1, 2, 3.5};
      return map.set_positions(std::vector{some_id()}, std::vector{p});
    }
    case 4: {
      PrototypeMap other(map.encoder(), 0, map.look_bits());
      add(other, seed);
      return map.update(other);
    }
    case 5: {  // and what was added can be taken back
      const auto codes = random.integers<std::int8_t>(12, -127, 127);
      const std::vector<std::int64_t> id = {random.integer(0, 40)};
      map.add_codes(id, {codes.data(), 1, 12});
      return map.remove_codes(id, {codes.data(), 1, 12});
    }
    case 6:
      return map.build_index(static_cast<std::size_t>(random.integer(1, 4)));
    case 7:
      return map.drop_index();
    case 8:
      return map.set_metadata(seed % 3 == 0 ? Metadata() : Metadata{{"n", std::to_string(seed)}});
    default:
      return add(map, seed);
  }
}

void any_history(std::size_t look_bits, std::uint32_t seed) {
  begin(look_bits);
  test::Random random(seed);
  std::optional<PrototypeMap> map(PrototypeMap::load(path, true));
  Content committed = bytes_of(*map);
  for (int step = 0; step < 150; ++step) {
    switch (random.integer(0, 9)) {
      case 0:
        map->compact();
        committed = bytes_of(*map);
        break;
      case 1:  // what was not committed is gone
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

// Two commits and the lengths of the journal after each.
struct Commits {
  explicit Commits(std::size_t look_bits) {
    begin(look_bits);
    map.emplace(PrototypeMap::load(path, true));
    for (int i = 0; i < 3; ++i) {
      lengths.push_back(fs::file_size(journal));
      states.push_back(bytes_of(*map));
      add(*map, 10 + static_cast<std::uint32_t>(i));
      if (i == 1) map->discard(std::vector{map->ids()[0]});
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

void torn_tails(std::size_t look_bits) {
  const Commits c(look_bits);
  // Cut off anywhere.
  for (std::size_t size = 0; size <= c.whole.size(); ++size) {
    std::size_t commits = 0;
    while (commits < 3 && c.lengths[commits + 1] <= size) ++commits;
    CHECK(c.opened({c.whole.begin(), c.whole.begin() + static_cast<std::ptrdiff_t>(size)}) ==
          c.states[commits]);
  }
  // Broken anywhere in the last record; padding does not count.
  std::size_t left_out = 0;
  for (std::size_t at = c.lengths[2]; at < c.whole.size(); ++at) {
    for (const int bits : {0xff, 0x01}) {
      Content broken = c.whole;
      broken[at] = static_cast<char>(broken[at] ^ bits);
      Content state;
      try {
        state = c.opened(broken);
      } catch (const std::exception& error) {
        std::printf("byte %zu: %s\n", at, error.what());
      }
      CHECK(state == c.states[2] || state == c.states[3]);
      left_out += state == c.states[2] ? 1 : 0;
    }
  }
  CHECK(left_out > (c.whole.size() - c.lengths[2]));
  // Broken before that: refused, whatever the byte, unless it is padding.
  std::size_t refused = 0;
  for (std::size_t at = 0; at < c.lengths[2]; ++at) {
    Content broken = c.whole;
    broken[at] = static_cast<char>(broken[at] ^ 0xff);
    try {
      CHECK(c.opened(broken) == c.states[3]);
    } catch (const FileError& error) {
      CHECK(std::string(error.what()).starts_with("map.journal: "));
      ++refused;
    }
  }
  CHECK(refused > c.lengths[2] / 2);
  // Opened to go on with, the tail is cut off.
  Content torn = c.whole;
  torn.resize(torn.size() - 70);
  write(journal, torn);
  CHECK(file_journal(path)->torn_bytes == torn.size() - c.lengths[2]);
  CHECK(fs::file_size(journal) == torn.size());
  PrototypeMap map = PrototypeMap::load(path, true);
  CHECK(fs::file_size(journal) == c.lengths[2]);
  CHECK(bytes_of(map) == c.states[2]);
  add(map, 12);
  map.commit();
  CHECK(bytes_of(map) == c.states[3]);
  CHECK(read(journal) == c.whole);
  CHECK(file_journal(path)->commits == 3 && file_journal(path)->torn_bytes == 0);
}

Content joined(std::initializer_list<std::span<const char>> parts) {
  Content result;
  for (const auto part : parts) result.insert(result.end(), part.begin(), part.end());
  return result;
}

template <typename Change>
Content with_container(std::span<const char> record, Change change) {
  const ContainerReader reader(std::as_bytes(record), "record");
  ContainerWriter writer(reader.kind());
  for (const auto& [name, size] : reader.sections()) {
    std::vector<std::byte> content(reader.read(name).begin(), reader.read(name).end());
    change(name, content);
    if (!content.empty()) writer.add(name, std::move(content));
  }
  const auto bytes = writer.serialize();
  Content result(bytes.size());
  std::memcpy(result.data(), bytes.data(), bytes.size());
  return result;
}

void refused() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  const auto head = all.first(c.lengths[0]);
  const auto record = [&](std::size_t i) {
    return all.subspan(c.lengths[i], c.lengths[i + 1] - c.lengths[i]);
  };
  const auto fails = [&](const Content& content, const std::string& why) {
    CHECK(check::throws<FileError>([&] { c.opened(content); }, why));
  };
  const std::string second = "record at byte " + std::to_string(c.lengths[1]);
  fails(joined({head, record(1)}), "it does not follow the one before it");
  fails(joined({head, record(0), record(0)}), second + ": it does not follow");
  fails(joined({head, record(0), record(2)}), second + ": it does not follow");
  fails(joined({head, record(0), head}), second + ": it is a journal");
  fails(joined({head, record(0), std::vector<char>(64), record(2)}),
        second + " is broken, and there are others behind it, at byte " +
            std::to_string(c.lengths[1] + 64));
  fails(joined({record(0)}), "it holds a record of a journal, not a journal");
  fails(joined({c.base}), "it holds an open map, not a journal");
  fails(Content(1000, 'x'), "not a Protomark file");

  // A later Protomark may write what this one does not know; that is no torn tail.
  for (const std::size_t field : {std::size_t{8}, std::size_t{12}}) {
    Content newer(record(2).begin(), record(2).end());
    newer[field] = 77;
    const auto sections = static_cast<std::size_t>(newer[24]);
    std::memset(&newer[28], 0, 4);
    const auto crc = crc32(std::as_bytes(std::span(newer)).first(64 + 32 * sections));
    std::memcpy(&newer[28], &crc, 4);
    fails(joined({head, record(0), record(1), newer}),
          field == 8 ? "format version 77" : "of a kind that this Protomark does not know");
  }
  // Right checksums and wrong content.
  const auto broken_second = [&](const std::string& section, const std::string& why) {
    const auto changed =
        with_container(record(1), [&](const std::string& name, std::vector<std::byte>& content) {
          if (name == section) content.resize(content.size() - 1);
        });
    fails(joined({head, record(0), changed}), why);
  };
  broken_second("gone", second + ": its section 'gone' is longer");
  broken_second("ids", "its section 'ids'");
  broken_second("sums", "its section 'sums'");
  broken_second("chain", "its section 'chain' is shorter");
  const auto impossible =
      with_container(record(1), [&](const std::string& name, std::vector<std::byte>& content) {
        if (name == "counts") content[0] = std::byte{0};
      });
  fails(joined({head, record(0), impossible}), "has an impossible prototype");
}

// Whatever stands within a commit that was interrupted, it is not what stands behind it.
void containers_within_a_torn_record() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  const auto commit = [](std::uint64_t number, const Content& text) {
    SectionWriter chain;
    chain.value(number);
    chain.value(std::uint64_t{0});
    ContainerWriter file(FileKind::commit);
    file.add("chain", chain.take());
    file.add("metadata", std::as_bytes(std::span(text)));
    const auto bytes = file.serialize();
    const auto* data = reinterpret_cast<const char*>(bytes.data());
    return Content(data, data + bytes.size());
  };
  const Content earlier(c.whole.begin(), c.whole.begin() + static_cast<long>(c.lengths[1]));
  const Content later = commit(5, {});
  for (const Content& text : {earlier, later}) {
    const Content record = commit(4, text);
    for (std::size_t size = 0; size < record.size(); size += 16) {
      CHECK(c.opened(joined({all, std::span(record).first(size)})) == c.states[3]);
    }
    Content broken = record;
    broken[128] = 0;  // the chain
    CHECK(c.opened(joined({all, broken})) == c.states[3]);
    CHECK(check::throws<FileError>(
        [&] { c.opened(joined({all, broken, later})); },
        "there are others behind it, at byte " + std::to_string(all.size() + record.size())));
  }
  // Where its header did not reach the disk, no record of before stands behind it.
  Content broken = commit(4, earlier);
  std::fill_n(broken.begin(), 64, 0);
  CHECK(c.opened(joined({all, broken})) == c.states[3]);
  CHECK(check::throws<FileError>([&] { c.opened(joined({all, broken, later})); },
                                 "at byte " + std::to_string(all.size() + broken.size())));
}

// Files that are large because nothing was ever written to most of them.
void holes() {
  begin(0);
  PrototypeMap::load(path, true).close();
  const Content head = read(journal);
  const PrototypeMap other(test::random_encoder());
  const auto refused = [&](const Content& content, const std::string& why) {
    write(journal, content);
    fs::resize_file(journal, std::uintmax_t{8} << 30);
    CHECK(check::throws<FileError>([] { PrototypeMap::load(path); }, why));
    CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, why));
    CHECK(check::throws<FileError>([&] { other.save(path); }, why));
  };
  refused({}, "map.pmk.journal: not a Protomark file");
  refused(Content(head.begin(), head.begin() + 64), "map.pmk.journal: ");
  refused(head, "map.pmk.journal: cannot be read: its 8589934592 bytes do not fit into memory");
  fs::remove(journal);
}

// Who may not read the map may not read its journal, nor the map once it is compacted.
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
  // Somebody puts another file there.
  write(path, other_bytes);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path); }, stale));
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, stale));
  CHECK(check::throws<FileError>([] { verify_file(path); }, stale));
  other.seal(folder / "sealed.pmk");
  fs::copy_file(folder / "sealed.pmk", path, fs::copy_options::overwrite_existing);
  CHECK(check::throws<FileError>([] { SealedMap{path}; }, stale));
  // And brings the right one back.
  write(path, c.base);
  CHECK(bytes_of(PrototypeMap::load(path)) == c.states[3]);

  // Nobody saves over commits.
  const std::string lost = "map.pmk: cannot be written: its journal holds 3 commits";
  CHECK(check::throws<FileError>([&] { other.save(path); }, lost));
  CHECK(check::throws<FileError>([&] { other.seal(path); }, lost));
  CHECK(read(path) == c.base && read(journal) == c.whole);
  // Nor while somebody may commit.
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

  // A map file that goes while it is open is noticed.
  PrototypeMap next = PrototypeMap::load(path, true);
  add(next, 1);
  write(path, c.base);
  CHECK(check::throws<FileError>([&] { next.commit(); }, "was replaced or deleted"));
  write(path, other_bytes);
  CHECK(next.commit() > 0);

  CHECK(
      check::throws<FileError>([] { PrototypeMap::load(folder / "none", true); }, "No such file"));
  CHECK(check::throws<FileError>([] { PrototypeMap::load(folder / "sealed.pmk", true); },
                                 "it holds a sealed map, not an open map"));
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

  // Another process is told which one has it; a copy of this one may not commit.
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

// A map file that is compacted twice while it is read, to an equal one in the end: its journal was
// that of the one in between.
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
      map.discard(id);
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
  broken[broken.size() - 100] = static_cast<char>(broken[broken.size() - 100] ^ 1);
  write(path, broken);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, "checksum"));
  CHECK(!fs::exists(journal));
  // One that was there stays.
  begin(0);
  PrototypeMap::load(path, true).close();
  const Content head = read(journal);
  write(path, broken);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path, true); }, "checksum"));
  CHECK(read(journal) == head);
}

// How many commits stand in the way, where a fold may have taken place or not.
void commits_to_other_map_files() {
  const Commits c(0);
  const auto all = std::span<const char>(c.whole);
  ContainerWriter fold(FileKind::fold);
  SectionWriter chain;
  std::uint32_t checksum;
  std::memcpy(&checksum, &c.whole[c.lengths[1] + 28], 4);
  chain.value(std::uint64_t{3});
  chain.value(checksum);
  chain.value(std::uint32_t{0});
  fold.add("chain", chain.take());
  fold.add("base", std::vector<std::byte>(64, std::byte{'a'}));
  const auto bytes = fold.serialize();
  Content folded(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(c.lengths[2]));
  const auto* data = reinterpret_cast<const char*>(bytes.data());
  folded.insert(folded.end(), data, data + bytes.size());
  const auto third = with_container(all.subspan(c.lengths[2]),
                                    [&](const std::string& name, std::vector<std::byte>& content) {
                                      if (name != "chain") return;
                                      const std::uint64_t number = 4;
                                      std::memcpy(content.data(), &number, 8);
                                      std::memcpy(&content[8], &bytes[28], 4);
                                    });
  Content longer = folded;
  longer.insert(longer.end(), third.begin(), third.end());

  CHECK(c.opened(longer) == c.states[3]);  // the fold did not take place
  CHECK(c.opened(folded) == c.states[2]);
  PrototypeMap other(test::random_encoder());
  add(other, 99);
  other.save(folder / "other.pmk");
  write(path, read(folder / "other.pmk"));
  write(journal, longer);
  CHECK(check::throws<FileError>([] { PrototypeMap::load(path); },
                                 "holds 3 commits to another map file than the one beside it, of "
                                 "which the first 2 may be in that file already"));
  write(journal, folded);
  CHECK(bytes_of(PrototypeMap::load(path)) == bytes_of(other));
}

// Files that are made to be slow to read: landmarks with thousands of looks, and others that come
// and go beside them. Rows are counted, not time.
void thousands_of_looks() {
  begin(12);
  PrototypeMap map = PrototypeMap::load(path, true);
  std::vector<std::int8_t> codes;
  for (int look = 0; look < 1 << 12; ++look) {
    for (int d = 0; d < 12; ++d) codes.push_back((look >> d & 1) != 0 ? 5 : -5);
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
  std::vector<std::int64_t> gone;
  for (std::int64_t id = 1; id <= kSmall; ++id) gone.push_back(id);
  map.discard(gone);
  map.commit();
  grow(1000);
  const Content expected = bytes_of(map);

  const Content file_bytes = read(path), journal_bytes = read(journal);
  const ContainerReader file(std::as_bytes(std::span(file_bytes)), "map");
  const JournalContent commits(std::as_bytes(std::span(journal_bytes)), "map.journal");
  PrototypeStore store(12, 12);
  read_open_map(file, commits, *map.encoder(), store);
  CHECK(store.landmarks() == 3 && store.rows() == 3 * (1 << 12));
  CHECK(store.steps() <= store.rows());
  map.close();
  CHECK(bytes_of(PrototypeMap::load(path)) == expected);
}

// Its cost follows what changed.
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
  for (const std::size_t look_bits : {0, 3}) {
    for (const std::uint32_t seed : {1, 2, 3}) any_history(look_bits, seed);
    torn_tails(look_bits);
  }
  refused();
  containers_within_a_torn_record();
  holes();
  permissions_of_the_map();
  other_map_files();
  one_writer();
  compacted_twice_meanwhile();
  nothing_is_left_behind();
  commits_to_other_map_files();
  thousands_of_looks();
  cost();
  fs::remove_all(folder);
  return check::result();
}
