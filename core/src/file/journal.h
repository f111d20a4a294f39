// The journal of a learning map: a file beside the map file with the commits made since that was
// written. It is a container of kind `journal`, followed by one for each commit and for each time
// that the map was folded into a new map file; each names the checksum of the one before it.
#pragma once

#include <unistd.h>

#include <memory>

#include "file/container.h"

namespace protomark {

// The section `chain` of a record.
struct ChainLink {
  uint64_t record;    // counted from 1
  uint32_t previous;  // checksum of the container before it
  uint32_t reserved;
};

// Returns the path of the journal beside a map file, or beside the file that it links to.
std::filesystem::path journal_path(const std::filesystem::path& map);

class JournalContent {
 public:
  struct Commit {
    Bytes bytes;    // a container
    size_t offset;  // in the journal
  };

  JournalContent() = default;
  // Reads all records but a torn last one, which a killed process or a power cut leaves. The bytes
  // stay the caller's. Throws FileError for what no writer leaves, as a torn record before others.
  JournalContent(Bytes bytes, std::string name);

  // Returns the commits to a map file of this identity. Throws FileError if they are to another.
  std::span<const Commit> commits(const std::string& identity) const;

  const std::string& name() const { return name_; }
  // Returns where the last whole record ends; 0 if there is not even a header.
  size_t end() const { return end_; }
  size_t size() const { return size_; }
  // Returns the number of records, and the checksum of the last one or of the header.
  ChainLink last() const { return last_; }
  // Whether the journal has no records and was begun for a map file of this identity.
  bool is_new(const std::string& identity) const {
    return last_.record == 0 && end_ != 0 && bases_.front().identity == identity;
  }

 private:
  // A map file that has the first `commits` commits.
  struct Base {
    std::string identity;
    size_t commits;
  };

  std::string name_;
  size_t size_ = 0;
  size_t end_ = 0;
  ChainLink last_{};
  std::vector<Commit> commits_;
  std::vector<Base> bases_;
};

// A map file and its journal that fit each other even if another map commits or compacts meanwhile.
struct JournaledFile {
  explicit JournaledFile(const std::filesystem::path& map);

  std::unique_ptr<const MappedFile> mapped;
  std::optional<ContainerReader> file;
  std::vector<std::byte> bytes;
  JournalContent journal;
};

// A journal to which one map, of all processes, writes. Functions throw FileError.
class Journal {
 public:
  // Locks the journal of a map file, or makes one. Errors name the process that holds the lock.
  explicit Journal(const std::filesystem::path& map);
  Journal(const Journal&) = delete;
  Journal& operator=(const Journal&) = delete;

  const std::filesystem::path& map() const { return map_; }
  std::vector<std::byte> read() const;
  // Prepares to append to this content, for a map file of this identity: cuts off a torn record,
  // and begins anew if no commit is to be applied to the map file.
  void resume(const JournalContent& content, const std::string& identity);

  ContainerWriter record(FileKind kind);
  // Returns once the record is durable. If that fails the journal is as before.
  void append(Bytes record);
  // Appends that a map file of this identity, about to replace the present one, has everything.
  void fold(const std::string& identity);
  // Drops all commits, as the map file now is the one of this identity. If that fails, a fold ends
  // them or half a header is left, so that they do not count, and the next commit tries again.
  void restart(const std::string& identity) noexcept;
  // Removes the file if this made it, as no map will commit after all.
  void abandon() noexcept;

 private:
  void check_owner() const;
  void begin();
  // Cuts off what an interrupted write may have left behind the end.
  bool cut(size_t size) { return ::ftruncate(file_.get(), static_cast<off_t>(size)) == 0; }

  std::filesystem::path map_, path_;
  FileDescriptor file_;  // locked while it is open, also in a forked child
  bool made_ = false;    // by this
  pid_t process_;
  std::string base_;    // identity of the map file
  std::string folded_;  // and of the one that may have replaced it
  size_t end_ = 0;
  ChainLink last_{};
};

// Writes a file. Throws FileError if a map has its journal, or that holds commits.
void write_guarded(const ContainerWriter& file, const std::filesystem::path& path);

}  // namespace protomark
