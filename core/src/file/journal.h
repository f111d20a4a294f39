// The journal of an open map: a file beside the map's that holds what was committed since that was
// written (docs/format.md).
//
// It is a container of kind `journal` and behind it one for each commit, and for each time that the
// map was folded into a new map file. Each names the checksum of the one before it.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "file/container.h"

namespace protomark {

// Beside the map file itself, where `map` is a link to it.
std::filesystem::path journal_path(const std::filesystem::path& map);

// What stands in a journal.
class JournalContent {
 public:
  struct Commit {
    Bytes bytes;         // a container
    std::size_t offset;  // in the journal
  };

  // Nothing is committed.
  JournalContent() = default;
  // Takes what is whole. A last record that is not, which a killed process or a power cut leaves,
  // is left out; the bytes stay the caller's. Throws FileError where a record that is not whole has
  // another one behind it, and for anything else that no journal holds.
  JournalContent(Bytes bytes, std::string name);

  // The commits to be applied to a map file of this identity, in order. Throws FileError where they
  // belong to another one.
  std::span<const Commit> commits(const std::string& identity) const;

  const std::string& name() const { return name_; }
  // Where the whole records end; 0: there is not even a header.
  std::size_t end() const { return end_; }
  std::size_t size() const { return size_; }
  // Bytes behind the end.
  std::size_t torn() const { return size_ - end_; }
  // Records in it, and the checksum of the last one or of the header.
  std::uint64_t records() const { return records_; }
  std::uint32_t checksum() const { return checksum_; }
  // Whether the journal was begun for a map file of this identity and has no records.
  bool is_new(const std::string& identity) const {
    return records_ == 0 && end_ != 0 && bases_.front().identity == identity;
  }

 private:
  // A map file that has all commits up to some number.
  struct Base {
    std::string identity;
    std::size_t commits;
  };

  std::string name_;
  std::size_t size_ = 0;
  std::size_t end_ = 0;
  std::uint64_t records_ = 0;
  std::uint32_t checksum_ = 0;
  std::vector<Commit> commits_;
  std::vector<Base> bases_;
};

// A map file and its journal, neither of them locked, and fitting each other whatever a map that
// commits and compacts does meanwhile.
class JournaledFile {
 public:
  // Throws FileError.
  explicit JournaledFile(const std::filesystem::path& map);

  const ContainerReader& file() const { return *file_; }
  const JournalContent& journal() const { return journal_; }

 private:
  std::unique_ptr<const MappedFile> mapped_;
  std::unique_ptr<const ContainerReader> file_;
  std::vector<std::byte> bytes_;
  JournalContent journal_;
};

// A journal that one map writes to; no other one, here or in another process, can at the same time.
class Journal {
 public:
  // Takes the journal of a map file, made where there is none. Throws FileError, with the process
  // that has it where somebody does.
  explicit Journal(const std::filesystem::path& map);
  ~Journal();
  Journal(const Journal&) = delete;
  Journal& operator=(const Journal&) = delete;

  const std::filesystem::path& map() const { return map_; }
  std::vector<std::byte> read() const;
  // Goes on behind what is in it. Cuts off a torn tail, and begins anew where nothing is to be
  // applied to the map file, which has this identity.
  void resume(const JournalContent& content, const std::string& identity);

  // The record to be appended next, of which the chain is there.
  ContainerWriter record(FileKind kind);
  // Returns when the record is there to stay. Throws FileError; the journal is then as before, and
  // one may try again.
  void append(Bytes record);
  // Appends that everything up to here is in a map file of this identity, which is to take the
  // place of the present one.
  void fold(const std::string& identity);
  // The map file is now the one of this identity: forgets all commits. Where that fails they stay,
  // behind them that they are in the map file, or a part of a header: nothing is to be applied, and
  // the next commit tries again.
  void restart(const std::string& identity) noexcept;
  // Nobody is to commit after all: takes the file away again where it was made here.
  void abandon() noexcept;

 private:
  void check_owner() const;
  void begin();
  bool cut(std::size_t size);
  [[noreturn]] void fail(const std::string& what) const;

  std::filesystem::path map_, path_;
  int descriptor_ = -1;
  bool made_ = false;  // the file was not there
  pid_t process_;
  std::string base_;    // identity of the map file
  std::string folded_;  // and of the one that may have taken its place
  std::size_t end_ = 0;
  std::uint64_t records_ = 0;
  std::uint32_t checksum_ = 0;
  bool tail_ = false;  // something may stand behind the end
};

// Keeps a map file from being opened with a journal while it is written over. Throws FileError
// where it is open so now, or where its journal holds commits, which would be lost.
class JournalGuard {
 public:
  explicit JournalGuard(const std::filesystem::path& map);
  ~JournalGuard();
  JournalGuard(const JournalGuard&) = delete;
  JournalGuard& operator=(const JournalGuard&) = delete;

 private:
  int descriptor_ = -1;
};

}  // namespace protomark
