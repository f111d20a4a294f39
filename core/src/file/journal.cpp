#include "file/journal.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <fstream>
#include <sstream>

#include "file/sections.h"
#include "protomark/types.h"

namespace protomark {
namespace {

constexpr char kSaveElsewhere[] = "; save to another path to keep what is in memory";
// Openings of a journal that somebody else deletes at the same moment.
constexpr int kTries = 100;

// Who has locked a file, which Linux tells.
std::string holder(const FileDescriptor& file) {
  struct stat status;
  if (::fstat(file.get(), &status) == 0) {
    std::ifstream locks("/proc/locks");
    for (std::string line; std::getline(locks, line);) {
      // 1: FLOCK  ADVISORY  WRITE 4711 fe:00:12345 0 EOF
      std::istringstream words(line);
      std::string number, kind, mode, access, inode;
      long process = 0;
      if (!(words >> number >> kind >> mode >> access >> process >> inode) || kind != "FLOCK" ||
          process <= 0 || !inode.ends_with(":" + std::to_string(status.st_ino))) {
        continue;
      }
      if (process == ::getpid()) return "another map of this process";
      return "process " + std::to_string(process);
    }
  }
  return "another map or process";
}

void add_base(ContainerWriter& file, const std::string& identity) {
  SectionWriter out;
  out.values(identity.data(), identity.size());
  out.add_to(file, section::kBase);
}

std::uint32_t checksum_of(Bytes container) { return ContainerHead::parse(container)->header.crc; }

// Locks the journal of a map file that is to be written over, if there is one.
FileDescriptor guard(const std::filesystem::path& map) {
  const auto path = journal_path(map);
  FileDescriptor file;
  for (int tries = 0; tries < kTries; ++tries) {
    file = FileDescriptor::open_to_read(path);
    if (!file && (errno == ENOENT || errno == ENAMETOOLONG || errno == ENOTDIR)) return file;
    if (!file) throw FileError(text(path.string(), ": cannot be read: ", system_error()));
    if (::flock(file.get(), LOCK_SH | LOCK_NB) != 0 && errno == EWOULDBLOCK) {
      throw FileError(text(map.string(), ": cannot be written: its journal is held by ",
                           holder(file), "; close it there, or save to another path"));
    }
    const auto bytes = read_journal(file, path);
    const auto commits = JournalContent(bytes, path.string()).commits(identity_of(map)).size();
    if (commits > 0) {
      throw FileError(text(map.string(), ": cannot be written: its journal holds ", commits,
                           " commits, which would be lost; open it with journal and compact it, "
                           "or save to another path"));
    }
    if (file.is_at(path)) break;
  }
  return file;
}

}  // namespace

Journal::Journal(const std::filesystem::path& map) : process_(::getpid()) {
  std::error_code error;
  map_ = std::filesystem::canonical(map, error);
  if (error) throw FileError(map.string() + ": cannot be read: " + error.message());
  path_ = journal_path(map_);
  // Who may not read the map may not read what is committed to it.
  const mode_t mode = permissions(map_).value_or(0) | S_IRUSR | S_IWUSR;
  for (int tries = 0; tries < kTries; ++tries) {
    file_ = FileDescriptor(::open(path_.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, mode));
    made_ = bool(file_);
    if (made_) ::fchmod(file_.get(), mode);  // the umask may have taken something away
    if (!made_) file_ = FileDescriptor(::open(path_.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, mode));
    if (!file_) fail_write();
    if (::flock(file_.get(), LOCK_EX | LOCK_NB) != 0) {
      if (errno != EWOULDBLOCK) fail("cannot be locked: ", system_error());
      fail("is held by ", holder(file_),
           ": one map at a time may commit to it; open without journal to read");
    }
    if (file_.is_at(path_)) return;
  }
  fail("is deleted again and again, or its file system does not number files");
}

void Journal::resume(const JournalContent& content, const std::string& identity) {
  base_ = identity;
  end_ = content.end();
  last_ = content.last();
  tail_ = content.end() != content.size();
  if (content.commits(identity).empty() && !content.is_new(identity)) end_ = 0;
  // Whoever made the journal, or compacted, may have been killed before this: the new map file's
  // name must be durable before what it replaces is forgotten.
  if (!sync_folder(path_)) fail("its folder cannot be synced: ", system_error());
  if (end_ == 0) {
    begin();
  } else if (!cut(end_) || ::fsync(file_.get()) != 0) {
    fail_write();
  }
}

bool Journal::cut(std::size_t size) {
  if (tail_ && ::ftruncate(file_.get(), static_cast<off_t>(size)) != 0) return false;
  tail_ = false;
  return true;
}

// Writes an empty file, then a header, so that nothing of before is left behind that.
void Journal::begin() {
  tail_ = true;
  if (!cut(0)) fail_write();
  end_ = 0;
  tail_ = true;
  ContainerWriter file(FileKind::journal);
  add_base(file, base_);
  const auto first = file.serialize();
  if (::fsync(file_.get()) != 0 || ::lseek(file_.get(), 0, SEEK_SET) != 0 || !file_.write(first) ||
      ::fsync(file_.get()) != 0) {
    fail_write();
  }
  end_ = first.size();
  last_ = {0, checksum_of(first), 0};
  tail_ = false;
}

void Journal::check_owner() const {
  if (::getpid() != process_) {
    fail("was opened by process ", process_,
         ", of which this one is a copy (fork); only that one may commit");
  }
  if (!file_.is_at(path_)) fail("was moved or deleted since it was opened", kSaveElsewhere);
}

ContainerWriter Journal::record(FileKind kind) {
  check_owner();
  if (end_ == 0) begin();
  ContainerWriter file(kind);
  add_value(file, section::kChain, ChainLink{last_.record + 1, last_.previous, 0});
  return file;
}

void Journal::append(Bytes record) {
  check_owner();
  const auto now = identity_of(map_);
  if (now != base_ && now != folded_) {
    fail("the map file beside it was replaced or deleted since it was opened", kSaveElsewhere);
  }
  base_ = now;
  if (!cut(end_)) fail_write();
  tail_ = true;
  if (::lseek(file_.get(), static_cast<off_t>(end_), SEEK_SET) < 0 || !file_.write(record) ||
      ::fsync(file_.get()) != 0) {
    const int error = errno;
    cut(end_);  // or before the next one
    errno = error;
    fail_write();
  }
  tail_ = false;
  end_ += record.size();
  last_ = {last_.record + 1, checksum_of(record), 0};
}

void Journal::fold(const std::string& identity) {
  ContainerWriter file = record(FileKind::fold);
  add_base(file, identity);
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
  // Whoever has opened it meanwhile finds it gone once they have the lock, and makes another one.
  if (made_ && file_.is_at(path_)) ::unlink(path_.c_str());
}

void write_guarded(const ContainerWriter& file, const std::filesystem::path& path) {
  const FileDescriptor before = guard(path);
  FileDescriptor last;
  file.write(path, [&](const std::string&) { last = guard(path); });
}

}  // namespace protomark
