#include "file/journal.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <fstream>

#include "file/sections.h"

namespace protomark {
namespace {

constexpr size_t kIdentitySize = 64;  // hexadecimal digits
// Size of a journal's first container: header, table and the section `base`.
constexpr size_t kFirstSize = 128 + kIdentitySize;

std::optional<ContainerHead> intact_head(Bytes bytes) {
  const auto head = ContainerHead::parse(bytes);
  return head && head->has_right_checksum() ? head : std::nullopt;
}

// Returns the container that bytes begin with; nullopt if its header is broken or it is cut off.
// Throws FileError for what no power cut leaves, such as one of a later version.
std::optional<ContainerReader> container_at(Bytes bytes, const std::string& name) {
  const auto head = intact_head(bytes);
  if (!head || head->header.file_size > bytes.size()) return std::nullopt;
  return ContainerReader(bytes.first(head->header.file_size), name);
}

// The same; nullopt, too, if anything else in it is broken.
std::optional<ContainerReader> whole_container(Bytes bytes, const std::string& name) try {
  auto result = container_at(bytes, name);
  if (!result || result->size() % kSectionAlignment != 0) return std::nullopt;
  result->verify();
  return result;
} catch (const FileError&) {
  return std::nullopt;
}

bool is_record(FileKind kind) { return kind == FileKind::commit || kind == FileKind::fold; }

// Returns the number of the record that bytes begin with; 0 if they begin with none.
uint64_t record_number(Bytes bytes) try {
  const auto file = container_at(bytes, "");
  // The size first, as reading the sections of many nested containers would take long.
  if (!file || !is_record(file->kind()) || file->map(section::kChain).size() != sizeof(ChainLink)) {
    return 0;
  }
  return read_value<ChainLink>(*file, section::kChain).record;
} catch (const FileError&) {
  return 0;
}

// Returns where a container begins that was written after the broken record at `broken`, or the
// size of the bytes if there is none. As that record may itself contain anything, even a container,
// the search begins behind it; if its header does not tell where that is, only a record with a
// number above those of the whole records counts.
size_t find_later(Bytes bytes, size_t broken, uint64_t records) {
  const auto head = intact_head(bytes.subspan(broken));
  const uint64_t size = head ? head->header.file_size : kSectionAlignment;
  if (size > bytes.size() - broken) return bytes.size();
  const uint64_t aligned = (size + kSectionAlignment - 1) / kSectionAlignment * kSectionAlignment;
  for (size_t at = broken + aligned; at < bytes.size(); at += kSectionAlignment) {
    const Bytes rest = bytes.subspan(at);
    if (head ? intact_head(rest).has_value() : record_number(rest) > records) return at;
  }
  return bytes.size();
}

// Whether the creation of this journal was interrupted, so that it has no commits yet.
bool is_unfinished(Bytes bytes) {
  return bytes.size() <= kFirstSize &&
         (has_magic(bytes) || std::ranges::all_of(bytes, [](auto b) { return b == std::byte{0}; }));
}

// Throws FileError with what is wrong with the beginning of a journal.
[[noreturn]] void refuse(Bytes bytes, const std::string& name) {
  ContainerReader(bytes.first(std::min(bytes.size(), kFirstSize)), name).verify();
  fail_file(name, "not a journal");
}

std::string read_base(const ContainerReader& file) {
  const auto digits = file.read<char>(section::kBase, kIdentitySize);
  return {digits.begin(), digits.end()};
}

constexpr char kSaveElsewhere[] = "; save to another path to keep what is in memory";
// Attempts to open a journal, or a map file and its journal, while others replace them.
constexpr int kTries = 100;

// Names who has locked a file, as far as Linux tells.
std::string holder(const FileDescriptor& file) {
  struct stat status{};
  ::fstat(file.get(), &status);
  const std::string inode = ":" + std::to_string(status.st_ino);
  std::ifstream locks("/proc/locks");
  for (std::string line; std::getline(locks, line);) {
    // 1: FLOCK  ADVISORY  WRITE 4711 fe:00:12345 0 EOF
    std::istringstream words(line);
    std::string number, kind, mode, access, place;
    long process = 0;
    words >> number >> kind >> mode >> access >> process >> place;
    if (kind != "FLOCK" || process <= 0 || !place.ends_with(inode)) continue;
    if (process == ::getpid()) return "another map of this process";
    return text("process ", process);
  }
  return "another map or process";
}

uint32_t checksum_of(Bytes container) { return ContainerHead::parse(container)->header.crc; }

// Reads an open journal, which its writer may cut off meanwhile. Throws FileError for another file.
std::vector<std::byte> read_journal(const FileDescriptor& file, const std::filesystem::path& path) {
  struct stat status;
  if (::fstat(file.get(), &status) != 0) fail_read(path);
  if (!S_ISREG(status.st_mode)) fail_file(path, "not a file");
  // A file that does not begin as a journal is not read, however large.
  const auto head = file.read(kMaxHead);
  if (head && head->size() > kFirstSize && !intact_head(*head)) refuse(*head, path.string());
  try {
    if (auto bytes = file.read(static_cast<size_t>(status.st_size))) return *std::move(bytes);
  } catch (const std::bad_alloc&) {
    fail_file(path, "cannot be read: its ", status.st_size, " bytes do not fit into memory");
  }
  fail_read(path);
}

// Returns the identity of the map file at `path`; empty if that cannot be read.
std::string identity_of(const std::filesystem::path& path) {
  const auto file = FileDescriptor::open_to_read(path);
  const auto bytes = file ? file.read(kMaxHead) : std::nullopt;
  const auto head = bytes ? ContainerHead::parse(*bytes) : std::nullopt;
  return head ? head->identity() : "";
}

// Locks the journal of a map file that is to be replaced, if there is one.
FileDescriptor guard(const std::filesystem::path& map) {
  const auto path = journal_path(map);
  FileDescriptor file;
  for (int tries = 0; tries < kTries; ++tries) {
    file = FileDescriptor::open_to_read(path);
    if (!file && (errno == ENOENT || errno == ENAMETOOLONG || errno == ENOTDIR)) return file;
    if (!file) fail_read(path);
    if (::flock(file.get(), LOCK_SH | LOCK_NB) != 0 && errno == EWOULDBLOCK) {
      fail_file(map, "cannot be written: its journal is held by ", holder(file),
                "; close it there, or save to another path");
    }
    const auto bytes = read_journal(file, path);
    const auto commits = JournalContent(bytes, path.string()).commits(identity_of(map)).size();
    if (commits > 0) {
      fail_file(map, "cannot be written: its journal holds ", commits,
                " commits, which would be lost; open it with journal and compact it, or save to "
                "another path");
    }
    if (file.is_at(path)) break;
  }
  return file;
}

}  // namespace

std::filesystem::path journal_path(const std::filesystem::path& map) {
  return link_target(map).string() + ".journal";
}

JournaledFile::JournaledFile(const std::filesystem::path& map) {
  const auto path = journal_path(map);
  // The map may be compacted meanwhile, even to an equal file; not all inodes are stable.
  for (int tries = 0;; ++tries) {
    const auto open = FileDescriptor::open_to_read(map);
    mapped = std::make_unique<MappedFile>(open, map);
    file.emplace(mapped->bytes(), map.string());
    const auto at_path = FileDescriptor::open_to_read(path);
    if (!at_path && errno != ENOENT && errno != ENAMETOOLONG) fail_read(path);
    bytes = at_path ? read_journal(at_path, path) : std::vector<std::byte>();
    if (identity_of(map) == file->identity() && (open.is_at(map) || tries >= kTries)) break;
  }
  journal = JournalContent(bytes, path.string());
}

JournalContent::JournalContent(Bytes bytes, std::string name)
    : name_(std::move(name)), size_(bytes.size()) {
  if (bytes.empty()) return;
  const auto first = whole_container(bytes, name_);
  if (!first) {
    if (!is_unfinished(bytes)) refuse(bytes, name_);
    container_at(bytes, name_);
    return;
  }
  first->expect(FileKind::journal);
  bases_.push_back({read_base(*first), 0});
  last_.previous = first->checksum();
  end_ = first->size();
  while (end_ < size_) {
    const std::string where = text(name_, ": record at byte ", end_);
    const auto record = whole_container(bytes.subspan(end_), where);
    if (!record) {
      container_at(bytes.subspan(end_), where);
      const size_t next = find_later(bytes, end_, last_.record);
      if (next == size_) return;
      throw FileError(text(where, " is broken, and another one follows at byte ", next,
                           ", which no power cut leaves; to keep the commits before it, cut the "
                           "journal off (truncate --size=",
                           end_, ")"));
    }
    record->require(is_record(record->kind()), "it is ", describe(record->kind()));
    const auto link = read_value<ChainLink>(*record, section::kChain);
    record->require(link.record == last_.record + 1 && link.previous == last_.previous,
                    "it does not follow the one before it");
    if (record->kind() == FileKind::commit) {
      commits_.push_back({bytes.subspan(end_, record->size()), end_});
    } else {
      bases_.push_back({read_base(*record), commits_.size()});
    }
    last_ = {link.record, record->checksum(), 0};
    end_ += record->size();
  }
}

std::span<const JournalContent::Commit> JournalContent::commits(const std::string& identity) const {
  // The last base of this identity counts, as a later map file may equal an earlier one.
  for (auto base = bases_.rbegin(); base != bases_.rend(); ++base) {
    if (base->identity == identity) return std::span(commits_).subspan(base->commits);
  }
  const size_t folded = bases_.empty() ? 0 : bases_.back().commits;
  if (commits_.size() == folded) return {};
  const std::string maybe =
      folded == 0 ? "" : text(", of which the first ", folded, " may be in that file already");
  throw FileError(text(name_, ": holds ", commits_.size(),
                       " commits to another map file than the one beside it", maybe,
                       ": bring that one back, or move the journal away to do without them"));
}

Journal::Journal(const std::filesystem::path& map) : process_(::getpid()) {
  std::error_code error;
  map_ = std::filesystem::canonical(map, error);
  if (error) fail_file(map, "cannot be read: ", error.message());
  path_ = journal_path(map_);
  // The journal is as readable as the map file.
  const mode_t mode = permissions(map_).value_or(0) | S_IRUSR | S_IWUSR;
  for (int tries = 0; tries < kTries; ++tries) {
    file_ = FileDescriptor(::open(path_.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, mode));
    made_ = bool(file_);
    if (made_) ::fchmod(file_.get(), mode);  // the umask may have removed some
    if (!made_) file_ = FileDescriptor(::open(path_.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, mode));
    if (!file_) fail_write(path_);
    if (::flock(file_.get(), LOCK_EX | LOCK_NB) != 0) {
      if (errno != EWOULDBLOCK) fail_file(path_, "cannot be locked: ", system_error());
      fail_file(path_, "is held by ", holder(file_),
                ": one map at a time may commit to it; open without journal to read");
    }
    if (file_.is_at(path_)) return;
  }
  fail_file(path_, "is deleted again and again, or its file system does not number files");
}

std::vector<std::byte> Journal::read() const { return read_journal(file_, path_); }

void Journal::resume(const JournalContent& content, const std::string& identity) {
  base_ = identity;
  end_ = content.end();
  last_ = content.last();
  if (content.commits(identity).empty() && !content.is_new(identity)) end_ = 0;
  // A process that compacted may have been killed before this: the name of the new map file must be
  // durable before the commits that it has are dropped.
  if (!sync_folder(path_)) fail_file(path_, "its folder cannot be synced: ", system_error());
  if (end_ == 0) {
    begin();
  } else if (!cut(end_) || ::fsync(file_.get()) != 0) {
    fail_write(path_);
  }
}

// Empties the file and syncs it before writing a header, so that no older record follows that.
void Journal::begin() {
  if (!cut(0)) fail_write(path_);
  end_ = 0;
  ContainerWriter file(FileKind::journal);
  file.add(section::kBase, std::as_bytes(std::span(base_)));
  const auto first = file.serialize();
  if (::fsync(file_.get()) != 0 || !file_.write(0, first) || ::fsync(file_.get()) != 0) {
    fail_write(path_);
  }
  end_ = first.size();
  last_ = {0, checksum_of(first), 0};
}

void Journal::check_owner() const {
  if (::getpid() != process_) {
    fail_file(path_, "was opened by process ", process_,
              ", of which this one is a copy (fork); only that one may commit");
  }
  if (file_.is_at(path_)) return;
  fail_file(path_, "was moved or deleted since it was opened", kSaveElsewhere);
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
    fail_file(path_, "the map file beside it was replaced or deleted since it was opened",
              kSaveElsewhere);
  }
  base_ = now;
  if (!cut(end_)) fail_write(path_);
  if (!file_.write(end_, record) || ::fsync(file_.get()) != 0) {
    const int error = errno;
    cut(end_);  // or before the next one
    errno = error;
    fail_write(path_);
  }
  end_ += record.size();
  last_ = {last_.record + 1, checksum_of(record), 0};
}

void Journal::fold(const std::string& identity) {
  ContainerWriter file = record(FileKind::fold);
  file.add(section::kBase, std::as_bytes(std::span(identity)));
  append(file.serialize());
  folded_ = identity;
}

void Journal::restart(const std::string& identity) noexcept {
  try {
    base_ = identity;
    begin();
  } catch (const std::exception&) {
    return;  // as after a power cut at this moment
  }
}

void Journal::abandon() noexcept {
  // A process that opened it meanwhile sees this once it has the lock, and makes another one.
  if (made_ && file_.is_at(path_)) ::unlink(path_.c_str());
}

void write_guarded(const ContainerWriter& file, const std::filesystem::path& path) {
  // Once more before the file is replaced, as another map may have opened it meanwhile.
  const FileDescriptor first = guard(path);
  FileDescriptor last;
  file.write(path, [&](const std::string&) { last = guard(path); });
}

}  // namespace protomark
