#include "file/journal.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <new>
#include <optional>
#include <sstream>
#include <utility>

#include "file/sections.h"
#include "protomark/error.h"

namespace protomark {
namespace {

constexpr char kMagic[] = "PROTOMRK";
constexpr std::size_t kMagicSize = 8, kAlignment = 64;
constexpr std::size_t kIdentitySize = 64;  // hexadecimal digits
// Of the container that a journal begins with.
constexpr std::size_t kHeadSize = 192;
// Of the largest header and section table.
constexpr std::size_t kMaxHead = 64 + 64 * 32;

struct Chain {
  std::uint64_t record;    // its number, from 1 on
  std::uint32_t previous;  // checksum of what stands before it
  std::uint32_t reserved;
};

bool begins_container(Bytes bytes) {
  return bytes.size() >= kAlignment && std::memcmp(bytes.data(), kMagic, kMagicSize) == 0;
}

// The whole container that bytes begin with; none where it is broken or cut off.
std::optional<ContainerReader> whole_container(Bytes bytes, const std::string& name) {
  if (!begins_container(bytes)) return std::nullopt;
  std::uint64_t size;
  std::memcpy(&size, bytes.data() + 16, sizeof(size));
  if (size > bytes.size() || size % kAlignment != 0) return std::nullopt;
  try {
    ContainerReader result(bytes.first(size), name);
    result.verify();
    return result;
  } catch (const FileError&) {
    return std::nullopt;
  }
}

// What the container that bytes begin with says of its size; none without a right header.
std::optional<std::uint64_t> stated_size(Bytes bytes) {
  if (!begins_container(bytes) || !has_container_head(bytes)) return std::nullopt;
  std::uint64_t size;
  std::memcpy(&size, bytes.data() + 16, sizeof(size));
  return size;
}

// Throws FileError where bytes begin with a container that is whole and yet not one to be read: it
// is not a power cut that made it so.
void check_known(Bytes bytes, const std::string& name) {
  const auto size = stated_size(bytes);
  if (size && *size <= bytes.size()) ContainerReader(bytes.first(*size), name);
}

bool is_record(const ContainerReader& file) {
  return file.kind() == FileKind::commit || file.kind() == FileKind::fold;
}

Chain read_chain(const ContainerReader& record) {
  SectionReader in(record, section::kChain);
  const auto chain = in.value<Chain>();
  in.finish();
  return chain;
}

// The number of the record that bytes begin with; 0 where they do not.
std::uint64_t record_number(Bytes bytes) {
  const auto size = stated_size(bytes);
  if (!size || *size > bytes.size()) return 0;
  try {
    const ContainerReader file(bytes.first(*size), "");
    const auto chain = file.map_if_there(section::kChain);
    // The size first: many that overlap would take long to be checked.
    if (!is_record(file) || !chain || chain->size() != sizeof(Chain)) return 0;
    return read_chain(file).record;
  } catch (const FileError&) {
    return 0;
  }
}

// Where something begins that was written after the record at `broken`, which is not whole, or the
// size of the bytes. Within that record anything may stand, such as a text that is a container. So
// the search begins behind it; where its header does not say where that is, only a record with a
// number above those of the ones before counts.
std::size_t find_later(Bytes bytes, std::size_t broken, std::uint64_t records) {
  const auto size = stated_size(bytes.subspan(broken));
  if (size && *size > bytes.size() - broken) return bytes.size();
  const std::uint64_t own = size ? (*size + kAlignment - 1) / kAlignment * kAlignment : kAlignment;
  for (std::size_t at = broken + own; at < bytes.size(); at += kAlignment) {
    const Bytes rest = bytes.subspan(at);
    if (size ? stated_size(rest).has_value() : record_number(rest) > records) return at;
  }
  return bytes.size();
}

// What is left where a journal's creation was interrupted: nothing was committed to it yet.
bool is_unfinished_head(Bytes bytes) {
  if (bytes.size() > kHeadSize) return false;
  const Bytes magic = bytes.first(std::min(bytes.size(), kMagicSize));
  return std::memcmp(magic.data(), kMagic, magic.size()) == 0 ||
         std::all_of(bytes.begin(), bytes.end(), [](std::byte b) { return b == std::byte{0}; });
}

// Throws FileError with what is wrong with the header of a journal.
[[noreturn]] void refuse_head(Bytes bytes, const std::string& name) {
  ContainerReader(bytes.first(std::min(bytes.size(), kHeadSize)), name).verify();
  throw FileError(name + ": not a journal");
}

std::string read_identity(const ContainerReader& file) {
  const Bytes bytes = file.read(section::kBase);
  if (bytes.size() != kIdentitySize) file.fail("its section 'base' has the wrong size");
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

std::vector<std::byte> text_bytes(const std::string& text) {
  const auto* p = reinterpret_cast<const std::byte*>(text.data());
  return {p, p + text.size()};
}

std::uint32_t checksum_of(Bytes container) {
  std::uint32_t result;
  std::memcpy(&result, container.data() + 28, sizeof(result));
  return result;
}

// A journal, of which whoever writes it may cut something off meanwhile. What is none is not read.
// A named pipe would keep whoever opens it waiting, unless it is opened with O_NONBLOCK.
std::vector<std::byte> read_all(int descriptor, const std::filesystem::path& path) {
  const auto fail = [&](const std::string& why) {
    throw FileError(path.string() + ": cannot be read: " + why);
  };
  struct stat status;
  if (::fstat(descriptor, &status) != 0) fail(system_error());
  if (!S_ISREG(status.st_mode)) throw FileError(path.string() + ": not a file");
  const auto size = static_cast<std::size_t>(status.st_size);
  const auto read = [&](std::span<std::byte> to) {
    std::size_t done = 0;
    while (done < to.size()) {
      const ssize_t n =
          ::pread(descriptor, to.data() + done, to.size() - done, static_cast<off_t>(done));
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) fail(system_error());
      if (n == 0) break;
      done += static_cast<std::size_t>(n);
    }
    return to.first(done);
  };
  std::array<std::byte, kMaxHead> space;
  const Bytes head = read(std::span(space).first(std::min(size, space.size())));
  if (head.size() > kHeadSize && !stated_size(head)) refuse_head(head, path.string());
  std::vector<std::byte> result;
  try {
    result.resize(size);
  } catch (const std::bad_alloc&) {
    fail("its " + std::to_string(size) + " bytes do not fit into memory");
  }
  result.resize(read(result).size());
  return result;
}

// Linux says who has locked a file; elsewhere nobody does.
std::string holder(int descriptor) {
  struct stat status;
  if (::fstat(descriptor, &status) == 0) {
    std::ifstream locks("/proc/locks");
    for (std::string line; std::getline(locks, line);) {
      // 1: FLOCK  ADVISORY  WRITE 4711 fe:00:12345 0 EOF
      std::istringstream words(line);
      std::string number, kind, mode, access, file;
      long process = 0;
      if (!(words >> number >> kind >> mode >> access >> process >> file) || kind != "FLOCK" ||
          process <= 0 || !file.ends_with(":" + std::to_string(status.st_ino))) {
        continue;
      }
      if (process == ::getpid()) return "another map of this process";
      return "process " + std::to_string(process);
    }
  }
  return "another map or process";
}

bool is_at(int descriptor, const std::filesystem::path& path) {
  struct stat own, there;
  return ::fstat(descriptor, &own) == 0 && ::stat(path.c_str(), &there) == 0 &&
         own.st_dev == there.st_dev && own.st_ino == there.st_ino;
}

}  // namespace

std::filesystem::path journal_path(const std::filesystem::path& map) {
  std::error_code error;
  const auto file = std::filesystem::canonical(map, error);
  return (error ? map : file).string() + ".journal";
}

namespace {

// The bytes of a journal; none where there is none.
std::vector<std::byte> read_journal(const std::filesystem::path& path) {
  const int descriptor = ::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
  if (descriptor < 0 && (errno == ENOENT || errno == ENAMETOOLONG)) return {};
  if (descriptor < 0) throw FileError(path.string() + ": cannot be read: " + system_error());
  try {
    auto bytes = read_all(descriptor, path);
    ::close(descriptor);
    return bytes;
  } catch (...) {
    ::close(descriptor);
    throw;
  }
}

// The identity of a file, by its first bytes; empty where it cannot be read.
std::string read_identity(const std::filesystem::path& path) {
  const int descriptor = ::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
  if (descriptor < 0) return "";
  std::array<std::byte, kMaxHead> head;
  const ssize_t n = ::pread(descriptor, head.data(), head.size(), 0);
  ::close(descriptor);
  return n <= 0 ? "" : file_identity(Bytes(head).first(static_cast<std::size_t>(n)));
}

}  // namespace

JournaledFile::JournaledFile(const std::filesystem::path& map) {
  constexpr int kTries = 100;
  const auto path = journal_path(map);
  // The map may be compacted between the two, to an equal one in the end whose journal was another
  // meanwhile. Not every file system gives a file the same number each time.
  for (int tries = 0;; ++tries) {
    mapped_ = std::make_unique<MappedFile>(map);
    file_ = std::make_unique<ContainerReader>(mapped_->bytes(), map.string());
    bytes_ = read_journal(path);
    const bool equal = read_identity(map) == file_->identity();
    if (equal && (mapped_->is_at(map) || tries >= kTries)) break;
  }
  journal_ = JournalContent(bytes_, path.string());
}

JournalContent::JournalContent(Bytes bytes, std::string name)
    : name_(std::move(name)), size_(bytes.size()) {
  if (bytes.empty()) return;
  const auto head = whole_container(bytes, name_);
  if (!head) {
    if (is_unfinished_head(bytes)) {
      check_known(bytes, name_);
      return;
    }
    refuse_head(bytes, name_);
  }
  head->expect(FileKind::journal);
  bases_.push_back({read_identity(*head), 0});
  checksum_ = head->checksum();
  end_ = head->size();
  while (end_ < size_) {
    const std::string where = name_ + ": record at byte " + std::to_string(end_);
    const auto record = whole_container(bytes.subspan(end_), where);
    if (!record) {
      check_known(bytes.subspan(end_), where);
      const std::size_t next = find_later(bytes, end_, records_);
      if (next == size_) return;
      throw FileError(where + " is broken, and there are others behind it, at byte " +
                      std::to_string(next) +
                      ": it was not a power cut that did this; to go on with the commits up to " +
                      "here, cut the journal there (truncate --size=" + std::to_string(end_) + ")");
    }
    if (!is_record(*record)) record->fail(std::string("it is ") + describe(record->kind()));
    const Chain chain = read_chain(*record);
    if (chain.record != records_ + 1 || chain.previous != checksum_) {
      record->fail("it does not follow the one before it");
    }
    if (record->kind() == FileKind::commit) {
      commits_.push_back({bytes.subspan(end_, record->size()), end_});
    } else {
      bases_.push_back({read_identity(*record), commits_.size()});
    }
    checksum_ = record->checksum();
    end_ += record->size();
    ++records_;
  }
}

std::span<const JournalContent::Commit> JournalContent::commits(const std::string& identity) const {
  // The last one: a map file may come again.
  for (auto base = bases_.rbegin(); base != bases_.rend(); ++base) {
    if (base->identity == identity) return std::span(commits_).subspan(base->commits);
  }
  const std::size_t folded = bases_.empty() ? 0 : bases_.back().commits;
  if (commits_.size() == folded) return {};
  std::string what =
      std::to_string(commits_.size()) + " commits to another map file than the one beside it";
  if (folded != 0) {
    what += ", of which the first ";
    what += std::to_string(folded);
    what += " may be in that file already";
  }
  throw FileError(name_ + ": holds " + what +
                  ": bring that one back, or move the journal away to do without them");
}

Journal::Journal(const std::filesystem::path& map) : process_(::getpid()) {
  std::error_code error;
  map_ = std::filesystem::canonical(map, error);
  if (error) throw FileError(map.string() + ": cannot be read: " + error.message());
  path_ = map_.string() + ".journal";
  // Whoever may not read the map may not read what is committed to it.
  const mode_t mode = permissions(map_).value_or(0) | S_IRUSR | S_IWUSR;
  for (;;) {
    descriptor_ = ::open(path_.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, mode);
    made_ = descriptor_ >= 0;
    if (made_) ::fchmod(descriptor_, mode);  // the umask may be another one
    if (!made_) descriptor_ = ::open(path_.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, mode);
    if (descriptor_ < 0) fail("cannot be written: " + system_error());
    if (::flock(descriptor_, LOCK_EX | LOCK_NB) != 0) {
      const bool taken = errno == EWOULDBLOCK;
      const std::string why =
          taken ? "is held by " + holder(descriptor_) +
                      ": one map at a time may commit to it; open without journal to read"
                : "cannot be locked: " + system_error();
      ::close(descriptor_);
      fail(why);
    }
    if (is_at(descriptor_, path_)) return;
    ::close(descriptor_);  // somebody has deleted it since
  }
}

// Closing gives the lock back, once a forked child has closed its copy, too.
Journal::~Journal() { ::close(descriptor_); }

std::vector<std::byte> Journal::read() const { return read_all(descriptor_, path_); }

void Journal::resume(const JournalContent& content, const std::string& identity) {
  base_ = identity;
  end_ = content.end();
  records_ = content.records();
  checksum_ = content.checksum();
  tail_ = content.torn() != 0;
  if (content.commits(identity).empty() && !content.is_new(identity)) end_ = 0;
  // Whoever made it, or compacted, may have been killed before: the map file's new name has to last
  // before what it replaces is forgotten.
  if (!sync_folder(path_)) fail("its folder cannot be synced: " + system_error());
  if (end_ == 0) {
    begin();
  } else if (!cut(end_) || ::fsync(descriptor_) != 0) {
    fail("cannot be written: " + system_error());
  }
}

bool Journal::cut(std::size_t size) {
  if (tail_ && ::ftruncate(descriptor_, static_cast<off_t>(size)) != 0) return false;
  tail_ = false;
  return true;
}

// An empty file, then a header: what was there is gone before anything takes its place.
void Journal::begin() {
  tail_ = true;
  if (!cut(0)) fail("cannot be written: " + system_error());
  end_ = 0;
  tail_ = true;
  ContainerWriter file(FileKind::journal);
  file.add(section::kBase, text_bytes(base_));
  const auto head = file.serialize();
  if (::fsync(descriptor_) != 0 || ::lseek(descriptor_, 0, SEEK_SET) != 0 ||
      !write_all(descriptor_, head) || ::fsync(descriptor_) != 0) {
    fail("cannot be written: " + system_error());
  }
  end_ = head.size();
  records_ = 0;
  checksum_ = checksum_of(head);
  tail_ = false;
}

void Journal::check_owner() const {
  if (::getpid() != process_) {
    fail("was opened by process " + std::to_string(process_) +
         ", of which this one is a copy (fork); only that one may commit");
  }
  if (!is_at(descriptor_, path_)) {
    fail(
        "was moved or deleted since it was opened; save to another path to keep what is in memory");
  }
}

ContainerWriter Journal::record(FileKind kind) {
  check_owner();
  if (end_ == 0) begin();
  ContainerWriter file(kind);
  SectionWriter chain;
  chain.value(Chain{records_ + 1, checksum_, 0});
  file.add(section::kChain, chain.take());
  return file;
}

void Journal::append(Bytes record) {
  check_owner();
  const auto now = read_identity(map_);
  if (now != base_ && now != folded_) {
    fail(
        "the map file beside it was replaced or deleted since it was opened; save to another "
        "path to keep what is in memory");
  }
  base_ = now;
  const auto try_to = [&] {
    if (!cut(end_)) return false;
    tail_ = true;
    return ::lseek(descriptor_, static_cast<off_t>(end_), SEEK_SET) >= 0 &&
           write_all(descriptor_, record) && ::fsync(descriptor_) == 0;
  };
  if (!try_to()) {
    const std::string why = system_error();
    cut(end_);  // or before the next one
    fail("cannot be written: " + why);
  }
  tail_ = false;
  end_ += record.size();
  ++records_;
  checksum_ = checksum_of(record);
}

void Journal::fold(const std::string& identity) {
  ContainerWriter file = record(FileKind::fold);
  file.add(section::kBase, text_bytes(identity));
  append(file.serialize());
  folded_ = identity;
}

void Journal::restart(const std::string& identity) noexcept {
  try {
    base_ = identity;
    begin();
  } catch (const std::exception&) {
    tail_ = true;  // as after a power cut at this moment
  }
}

void Journal::abandon() noexcept {
  // Whoever has opened it meanwhile finds it gone when they have the lock, and makes another one.
  if (made_ && is_at(descriptor_, path_)) ::unlink(path_.c_str());
}

void Journal::fail(const std::string& what) const { throw FileError(path_.string() + ": " + what); }

JournalGuard::JournalGuard(const std::filesystem::path& map) {
  // Not of the file that a link leads to: it is the link that will be replaced.
  const std::filesystem::path path = map.string() + ".journal";
  for (;;) {
    descriptor_ = ::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
    if (descriptor_ < 0 && (errno == ENOENT || errno == ENAMETOOLONG || errno == ENOTDIR)) return;
    if (descriptor_ < 0) throw FileError(path.string() + ": cannot be read: " + system_error());
    try {
      if (::flock(descriptor_, LOCK_SH | LOCK_NB) != 0 && errno == EWOULDBLOCK) {
        throw FileError(map.string() + ": cannot be written: its journal is held by " +
                        holder(descriptor_) + "; close it there, or save to another path");
      }
      const auto bytes = read_all(descriptor_, path);
      const std::size_t commits =
          JournalContent(bytes, path.string()).commits(read_identity(map)).size();
      if (commits > 0) {
        throw FileError(map.string() + ": cannot be written: its journal holds " +
                        std::to_string(commits) +
                        " commits, which would be lost; open it with journal and compact it, or "
                        "save to another path");
      }
    } catch (...) {
      ::close(descriptor_);
      throw;
    }
    if (is_at(descriptor_, path)) return;
    ::close(descriptor_);  // somebody has deleted it since
  }
}

JournalGuard::~JournalGuard() {
  if (descriptor_ >= 0) ::close(descriptor_);
}

}  // namespace protomark
