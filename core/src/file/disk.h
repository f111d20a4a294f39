// Writes files so that they exist whole or not at all, and maps files to read them.
#pragma once

#include <sys/types.h>

#include <filesystem>
#include <utility>

#include "base/bytes.h"
#include "base/text.h"

namespace protomark {

std::string system_error();

[[noreturn]] void fail_file(const std::filesystem::path& path, const auto&... what) {
  throw FileError(text(path.string(), ": ", what...));
}

[[noreturn]] inline void fail_read(const std::filesystem::path& path) {
  fail_file(path, "cannot be read: ", system_error());
}
[[noreturn]] inline void fail_write(const std::filesystem::path& path) {
  fail_file(path, "cannot be written: ", system_error());
}

class FileDescriptor {
 public:
  FileDescriptor() = default;
  explicit FileDescriptor(int descriptor) : descriptor_(descriptor) {}
  // Opens a file to read it, without waiting for the writer of a named pipe.
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

  // Reads up to n bytes from the beginning. Returns nullopt, with errno set, on failure.
  std::optional<std::vector<std::byte>> read(size_t n) const;
  // Writes all bytes from an offset on. Returns false, with errno set, on failure; never a signal.
  bool write(size_t offset, Bytes bytes) const;
  // Whether the file still has this name.
  bool is_at(const std::filesystem::path& path) const;

 private:
  int descriptor_ = -1;
};

// Returns the path, existing or not, to which a path leads if it is a symbolic link.
std::filesystem::path link_target(std::filesystem::path path);

// Syncs the folder of `path`, as otherwise a power cut may bring the old name back. Returns false,
// with errno set, on failure, but true if the file system or the folder's permissions rule it out.
bool sync_folder(const std::filesystem::path& path);

std::optional<mode_t> permissions(const std::filesystem::path& path);

// A file that is written beside its target (if that is a link, beside the file that it leads to),
// with the permissions of an existing target, which must be a regular file, and removed unless it
// replaces the target. All functions throw FileError.
class TemporaryFile {
 public:
  explicit TemporaryFile(const std::filesystem::path& target);
  ~TemporaryFile();
  TemporaryFile(const TemporaryFile&) = delete;
  TemporaryFile& operator=(const TemporaryFile&) = delete;

  void write(size_t offset, Bytes bytes);
  void sync();
  void replace_target();

 private:
  std::filesystem::path name_, target_;  // as errors call the target, and where it leads
  std::filesystem::path path_;
  FileDescriptor file_;
};

class MappedFile {
 public:
  // Throw FileError if the file cannot be read; errors call an open one `path`.
  explicit MappedFile(const std::filesystem::path& path);
  MappedFile(const FileDescriptor& file, const std::filesystem::path& path);
  ~MappedFile();
  MappedFile(const MappedFile&) = delete;
  MappedFile& operator=(const MappedFile&) = delete;

  Bytes bytes() const { return bytes_; }
  // Whether nobody has written to the file since it was mapped: its size and the time of its last
  // change are the same. A file of another inode that takes its name changes nothing.
  bool unchanged() const;

 private:
  using Stamp = std::array<int64_t, 3>;  // size, seconds and nanoseconds of the last change
  static std::optional<Stamp> stamp_of(const FileDescriptor& file);

  FileDescriptor file_;
  std::optional<Stamp> stamp_;
  Bytes bytes_;
};

}  // namespace protomark
