// The steps of a save, their order, and the files after a step that fails.
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "check.h"
#include "faulty_disk.h"
#include "file/sections.h"
#include "protomark/protomark.h"
#include "random.h"

namespace fs = std::filesystem;

using namespace protomark;

namespace {

std::vector<char> read(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

std::size_t files(const fs::path& folder) {
  return static_cast<std::size_t>(std::distance(fs::directory_iterator(folder), {}));
}

PrototypeMap map_of(std::size_t landmarks) {
  PrototypeMap map(test::random_encoder());
  test::Random random(3);
  const auto codes = random.integers<std::int8_t>(landmarks * 12, -127, 127);
  std::vector<std::int64_t> ids(landmarks);
  for (std::size_t i = 0; i < landmarks; ++i) ids[i] = static_cast<std::int64_t>(i);
  map.add_codes(ids, {codes.data(), landmarks, 12});
  return map;
}

// Sections that are produced while they are written.
void pieces(const fs::path& path) {
  const auto values = test::Random(4).integers<std::int32_t>(300'000, -1000, 1000);
  ContainerWriter whole(FileKind::encoder), pieced(FileKind::encoder);
  const Bytes bytes = std::as_bytes(std::span(values));
  whole.add("none", Bytes());
  whole.add("values", bytes);
  whole.add("first", bytes.first(100));
  whole.add("second", bytes);
  whole.add("last", bytes);
  pieced.add({{"none", 0}, {"values", bytes.size()}}, [&](ContainerWriter::Writers& to) {
    for (std::size_t i = 0; i < values.size(); i += 3) {
      to["values"].add(std::array{values[i], values[i + 1], values[i + 2]});
    }
  });
  // Produced side by side, in any order.
  pieced.add({{"first", 100}, {"second", bytes.size()}, {"last", ContainerWriter::kUnknownSize}},
             [&](ContainerWriter::Writers& to) {
               to["last"].add_all(bytes.first(7));
               to["second"].add_all(bytes.first(1000));
               to["first"].add_all(bytes.first(100));
               to["last"].add_all(bytes.subspan(7));
               to["second"].add_all(bytes.subspan(1000));
             });
  CHECK(pieced.serialize() == whole.serialize());
  pieced.write(path);
  const auto old_bytes = read(path);
  CHECK(std::ranges::equal(std::as_bytes(std::span(old_bytes)), whole.serialize()));

  // If a producer throws, the old file stays.
  pieced.add({{"broken", 1}},
             [](ContainerWriter::Writers&) { throw std::invalid_argument("no such value"); });
  CHECK(check::throws<std::invalid_argument>([&] { pieced.write(path); }, "no such value"));
  CHECK(read(path) == old_bytes && files(path.parent_path()) == 1);
  for (const std::size_t size : {3u, 5u}) {
    ContainerWriter other(FileKind::encoder);
    other.add({{"four", size}}, [](auto& to) { to["four"].add_all(std::vector<std::byte>(4)); });
    CHECK(check::throws<std::logic_error>([&] { other.write(path); }, "has 4 bytes, not"));
    CHECK(read(path) == old_bytes && files(path.parent_path()) == 1);
  }
  fs::remove(path);
}

// A target may be a link, which stays and leads to the new file, or have a long name, but is no
// device.
void targets(const PrototypeMap& old_map, const PrototypeMap& new_map, const fs::path& folder) {
  const fs::path real = folder / "real.pmk", link = folder / "link.pmk", far = folder / "far.pmk";
  fs::create_symlink("real.pmk", link);
  fs::create_symlink(link, far);
  old_map.save(far);  // which leads to nothing yet
  CHECK(fs::is_symlink(link) && fs::is_symlink(far) && PrototypeMap::load(real).size() == 50);
  new_map.save(far);
  CHECK(fs::is_symlink(link) && fs::is_symlink(far) && PrototypeMap::load(real).size() == 100);
  for (const std::size_t length : {240, 250, 255}) {
    const fs::path path = folder / std::string(length, 'x');
    old_map.save(path);
    new_map.save(path);
    CHECK(PrototypeMap::load(path).size() == 100);
  }
  CHECK(check::throws<FileError>([&] { old_map.save(folder / std::string(256, 'x')); },
                                 "File name too long"));
  const fs::path pipe = folder / "pipe";
  ::mkfifo(pipe.c_str(), 0600);
  for (const fs::path& path : {pipe, folder, fs::path("/dev/null")}) {
    const std::string why = path.string() + ": cannot be written: it exists and is not a regular";
    CHECK(check::throws<FileError>([&] { old_map.save(path); }, why));
    CHECK(check::throws<FileError>([&] { old_map.seal(path); }, why));
    CHECK(check::throws<FileError>([&] { old_map.encoder()->save(path); }, why));
  }
  CHECK(fs::is_fifo(pipe) && fs::is_character_file("/dev/null"));
}

// A limit on file sizes gives an error, though the system would end the program.
void size_limit(const PrototypeMap& map, const fs::path& folder) {
  const std::size_t before = files(folder);
  rlimit limit;
  ::getrlimit(RLIMIT_FSIZE, &limit);
  const rlimit low{1000, limit.rlim_max};
  ::setrlimit(RLIMIT_FSIZE, &low);
  CHECK(check::throws<FileError>([&] { map.save(folder / "large.pmk"); }, "File too large"));
  ::setrlimit(RLIMIT_FSIZE, &limit);
  CHECK(files(folder) == before);
  map.save(folder / "large.pmk");
}

}  // namespace

int main() {
  const fs::path folder =
      fs::temp_directory_path() / ("protomark_durability_" + std::to_string(::getpid()));
  fs::create_directory(folder);
  const fs::path path = folder / "map.pmk";
  pieces(path);
  const PrototypeMap old_map = map_of(50), new_map = map_of(100);

  disk = {};
  new_map.save(path);
  CHECK(disk.calls == std::vector<std::string>{"sync file", "rename", "sync folder"});
  const auto new_bytes = read(path);
  disk = {};
  old_map.save(path);
  const auto old_bytes = read(path);
  CHECK(old_bytes != new_bytes && files(folder) == 1);

  // A full disk, from the first byte to the last.
  const long size = static_cast<long>(new_bytes.size());
  for (const long room : {0l, 1l, 63l, 64l, 500l, size / 2, size - 64, size - 1}) {
    disk = {};
    disk.room = room;
    CHECK(check::throws<FileError>([&] { new_map.save(path); },
                                   "map.pmk: cannot be written: No space left on device"));
    CHECK(read(path) == old_bytes && files(folder) == 1);
  }
  const auto fails = [&](int Disk::* step, int error, const std::string& message) {
    disk = {};
    disk.*step = error;
    CHECK(check::throws<FileError>([&] { new_map.save(path); }, message));
    CHECK(files(folder) == 1);
  };
  fails(&Disk::fsync_file, EIO, "map.pmk: cannot be written: Input/output error");
  CHECK(read(path) == old_bytes);
  fails(&Disk::rename, EACCES, "map.pmk: cannot be written: Permission denied");
  CHECK(read(path) == old_bytes);
  disk = {};
  CHECK(check::throws<FileError>([&] { new_map.save(folder / "none" / "map.pmk"); },
                                 "No such file or directory"));

  // Here the new map exists, and the caller learns that a power cut may undo it.
  fails(&Disk::fsync_folder, EIO, "its folder cannot be synced: Input/output error");
  CHECK(read(path) == new_bytes);

  // Not every file system can sync a folder, and a write may stop early or be interrupted.
  disk = {};
  disk.fsync_folder = EINVAL;
  old_map.save(path);
  CHECK(read(path) == old_bytes);
  disk = {};
  disk.write_at_most = 77;
  new_map.save(path);
  CHECK(read(path) == new_bytes && files(folder) == 1);

  disk = {};
  const mode_t mask = ::umask(027);
  old_map.save(folder / "other.pmk");
  ::umask(mask);
  CHECK(fs::status(folder / "other.pmk").permissions() == fs::perms(0640));
  // A file that is replaced keeps its permissions, whatever the umask.
  for (const auto mode : {fs::perms(0600), fs::perms(0664), fs::perms(0400)}) {
    fs::permissions(folder / "other.pmk", mode);
    new_map.save(folder / "other.pmk");
    CHECK(fs::status(folder / "other.pmk").permissions() == mode);
    CHECK(read(folder / "other.pmk") == new_bytes);
  }
  disk.calls.clear();
  old_map.seal(folder / "sealed.pmk");
  CHECK(disk.calls.size() == 3);
  targets(old_map, new_map, folder);
  size_limit(old_map, folder);
  fs::remove_all(folder);
  return check::result();
}
