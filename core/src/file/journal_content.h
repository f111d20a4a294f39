// Reads the journal of a learning map: a file beside the map's that holds what was committed since
// that was written (docs/format.md).
//
// It is a container of kind `journal`, followed by one per commit and one per time that the map was
// folded into a new map file. Each names the checksum of the one before it.
#pragma once

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

// What a record says of the one before it.
struct ChainLink {
  std::uint64_t record;    // its own number, from 1 on
  std::uint32_t previous;  // checksum of the container before it
  std::uint32_t reserved;
};

// Returns the path of the journal beside a map file, or beside the file that it links to.
std::filesystem::path journal_path(const std::filesystem::path& map);

// Returns the bytes of a journal that is open, of which its writer may cut something off meanwhile.
// Throws FileError, with `path`, if that is not a journal.
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
  // Bytes behind the end.
  std::size_t torn() const { return size_ - end_; }
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

}  // namespace protomark
