// Writes files that are there whole or not at all and outlast a power cut, and maps files to read
// them.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <utility>

namespace protomark {

using Bytes = std::span<const std::byte>;

// Returns what errno says.
std::string system_error();

// An open file; closed when this goes.
class FileDescriptor {
 public:
  FileDescriptor() = default;
  explicit FileDescriptor(int descriptor) : descriptor_(descriptor) {}
  // Opens a file to read it; does not wait for the writer of a named pipe.
  static FileDescriptor open_to_read(const std::filesystem::path& path);
  FileDescriptor(FileDescriptor&& other) noexcept : descriptor_(other.release()) {}
  FileDescriptor& operator=(FileDescriptor&& other) noexcept {
    std::swap(descriptor_, other.descriptor_);
    return *this;
  }
  ~FileDescriptor();

  explicit operator bool() const { return descriptor_ >= 0; }
  int get() const { return descriptor_; }
  int release() { return std::exchange(descriptor_, -1); }

  // Reads from the beginning up to to.size() bytes, or to the end of the file. nullopt, with errno
  // set, if that fails.
  std::optional<std::span<std::byte>> read(std::span<std::byte> to) const;
  // Writes all of the bytes at the current offset. False, with errno set, if that fails; so does a
  // limit on file sizes, which raises no signal.
  bool write(Bytes bytes) const;
  // Whether the file still has that name.
  bool is_at(const std::filesystem::path& path) const;

 private:
  int descriptor_ = -1;
};

// Follows a path that is a symbolic link to the path that the link leads to, there or not.
std::filesystem::path link_target(std::filesystem::path path);

// Syncs the folder of `path`: without this a power cut may bring the old name back. False, with
// errno set, if that fails; true if the file system cannot do it or the folder cannot be read.
bool sync_folder(const std::filesystem::path& path);

// The permission bits of a file; nullopt if there is none.
std::optional<mode_t> permissions(const std::filesystem::path& path);

// A file that is written beside its target, or beside the file that the target links to, with the
// permissions of an existing target. Removed unless it takes the target's place. All functions
// throw FileError.
class TemporaryFile {
 public:
  // Refuses a target that is there and is no regular file.
  explicit TemporaryFile(const std::filesystem::path& target);
  ~TemporaryFile();
  TemporaryFile(const TemporaryFile&) = delete;
  TemporaryFile& operator=(const TemporaryFile&) = delete;

  void write(std::size_t offset, Bytes bytes);
  // Ends the writing and makes it outlast a power cut.
  void sync();
  // Renames the synced file over its target, and syncs the folder.
  void replace_target();

 private:
  [[noreturn]] void fail() const;

  std::filesystem::path name_, target_;  // what errors call the target, and what it leads to
  std::filesystem::path path_;
  FileDescriptor file_;
  std::size_t offset_ = 0;  // of the descriptor
};

// A file mapped read-only.
class MappedFile {
 public:
  // Throws FileError if the file cannot be read.
  explicit MappedFile(const std::filesystem::path& path);
  ~MappedFile();
  MappedFile(const MappedFile&) = delete;
  MappedFile& operator=(const MappedFile&) = delete;

  Bytes bytes() const { return bytes_; }
  // Whether the file still has that name.
  bool is_at(const std::filesystem::path& path) const;

 private:
  Bytes bytes_;
  dev_t device_ = 0;
  ino_t inode_ = 0;
};

}  // namespace protomark
