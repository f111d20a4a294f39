// The journal of a learning map: a file beside the map's that holds what was committed since that
// was written (docs/format.md).
//
// It is a container of kind `journal`, followed by one per commit and one per time that the map was
// folded into a new map file. Each names the checksum of the one before it.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "file/container.h"

namespace protomark {

// What a record says of itself and the one before it.
struct ChainLink {
  std::uint64_t record;    // its number, from 1 on
  std::uint32_t previous;  // checksum of the container before it
  std::uint32_t reserved;
};

// Returns the path of the journal beside a map file, or beside the file that it links to.
std::filesystem::path journal_path(const std::filesystem::path& map);

// Returns the bytes of a journal that is open, which its writer may cut off meanwhile. Throws
// FileError, with `path`, if that is not a journal.
std::vector<std::byte> read_journal(const FileDescriptor& file, const std::filesystem::path& path);

// Returns the identity of the map file at `path`, by its head; empty if that cannot be read.
std::string identity_of(const std::filesystem::path& path);

// What a journal holds.
class JournalContent {
 public:
  struct Commit {
    Bytes bytes;         // a container
    std::size_t offset;  // in the journal
  };

  // A journal without commits.
  JournalContent() = default;
  // Takes what is whole; the bytes stay the caller's. A last record that is not whole, as a killed
  // process or a power cut leaves it, is left out. Throws FileError if another record stands behind
  // it, and for anything else that no journal holds.
  JournalContent(Bytes bytes, std::string name);

  // Returns the commits to apply to a map file of this identity, in order. Throws FileError if they
  // belong to another one.
  std::span<const Commit> commits(const std::string& identity) const;

  const std::string& name() const { return name_; }
  // Where the whole records end; 0 if there is not even a header.
  std::size_t end() const { return end_; }
  std::size_t size() const { return size_; }
  // The number of records, and the checksum of the last one or of the header.
  ChainLink last() const { return last_; }
  // Whether the journal was begun for a map file of this identity and has no records.
  bool is_new(const std::string& identity) const {
    return last_.record == 0 && end_ != 0 && bases_.front().identity == identity;
  }

 private:
  // A map file that holds the first `commits` commits.
  struct Base {
    std::string identity;
    std::size_t commits;
  };

  std::string name_;
  std::size_t size_ = 0;
  std::size_t end_ = 0;
  ChainLink last_{};
  std::vector<Commit> commits_;
  std::vector<Base> bases_;
};

// A map file and its journal, read without a lock: they fit each other even if a map commits and
// compacts meanwhile.
class JournaledFile {
 public:
  // Throws FileError.
  explicit JournaledFile(const std::filesystem::path& map);

  const ContainerReader& file() const { return *file_; }
  const JournalContent& journal() const { return journal_; }

 private:
  std::unique_ptr<const MappedFile> mapped_;
  std::optional<ContainerReader> file_;
  std::vector<std::byte> bytes_;
  JournalContent journal_;
};

// A journal that one map writes to; no other map, in this process or another, can at the same time.
// Functions throw FileError.
class Journal {
 public:
  // Locks the journal of a map file, and makes it if there is none. Throws FileError, which names
  // the process that holds the lock.
  explicit Journal(const std::filesystem::path& map);
  Journal(const Journal&) = delete;
  Journal& operator=(const Journal&) = delete;

  const std::filesystem::path& map() const { return map_; }
  std::vector<std::byte> read() const { return read_journal(file_, path_); }
  // Goes on behind what the journal holds, for a map file of this identity. Cuts off a torn tail,
  // and begins anew if nothing is to be applied to the map file.
  void resume(const JournalContent& content, const std::string& identity);

  // Begins the next record, with its chain link.
  ContainerWriter record(FileKind kind);
  // Returns once the record is durable. If that fails the journal is as before, and one may try
  // again.
  void append(Bytes record);
  // Appends that everything so far is in a map file of this identity, which is about to take the
  // place of the present one.
  void fold(const std::string& identity);
  // Forgets all commits, as the map file now is the one of this identity. If that fails, the
  // commits stay behind a fold that ends them, or half a header stays, neither of which counts, and
  // the next commit tries again.
  void restart(const std::string& identity) noexcept;
  // Removes the file if it was made here, as no map will commit after all.
  void abandon() noexcept;

 private:
  void check_owner() const;
  void begin();
  bool cut(std::size_t size);
  template <typename... Parts>
  [[noreturn]] void fail(const Parts&... what) const {
    throw FileError(text(path_.string(), ": ", what...));
  }
  [[noreturn]] void fail_write() const { fail("cannot be written: ", system_error()); }

  std::filesystem::path map_, path_;
  FileDescriptor file_;  // locked while it is open, also in a forked child
  bool made_ = false;    // the file was not there
  pid_t process_;
  std::string base_;    // identity of the map file
  std::string folded_;  // and of the one that may have taken its place
  std::size_t end_ = 0;
  ChainLink last_{};
  bool tail_ = false;  // something may stand behind the end
};

// Writes a file over any that is there, unless that is open as a map with a journal, or its journal
// holds commits, which would be lost; also if that begins meanwhile. Throws FileError.
void write_guarded(const ContainerWriter& file, const std::filesystem::path& path);

}  // namespace protomark
