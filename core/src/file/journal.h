// Writes the journal of a learning map (journal_content.h), and keeps others from writing over it.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <filesystem>
#include <string>
#include <vector>

#include "file/container.h"
#include "file/journal_content.h"

namespace protomark {

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
  [[noreturn]] void fail(const std::string& what) const;

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

// Keeps a file from being opened as a map with a journal while it is written over. Throws FileError
// if it is open so, or if its journal holds commits, which would be lost.
class JournalGuard {
 public:
  explicit JournalGuard(const std::filesystem::path& map);

 private:
  FileDescriptor file_;
};

// Writes a file over any that is there, unless that has a journal in use or with commits, also if
// somebody begins one meanwhile. Throws FileError.
void write_guarded(const ContainerWriter& file, const std::filesystem::path& path);

}  // namespace protomark
