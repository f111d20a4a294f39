// Writing so that it lasts, and that files are there whole or not at all.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <filesystem>
#include <optional>
#include <span>
#include <string>

namespace protomark {

using Bytes = std::span<const std::byte>;

// What errno says.
std::string system_error();

// Writes all of the bytes where the descriptor stands. False, with errno set, where that fails.
bool write_all(int descriptor, Bytes bytes);

// Syncs the folder of `path`: without this a power cut may bring the old name back. False, with
// errno set, where that fails, and not where the file system cannot or the folder is not readable.
bool sync_folder(const std::filesystem::path& path);

// Who may read and write a file, as chmod takes it; none where there is no such file.
std::optional<mode_t> permissions(const std::filesystem::path& path);

// A file being written beside its target, with the target's permissions where there is one; removed
// unless it takes the target's place. All throw FileError.
class TemporaryFile {
 public:
  explicit TemporaryFile(const std::filesystem::path& target);
  ~TemporaryFile();
  TemporaryFile(const TemporaryFile&) = delete;
  TemporaryFile& operator=(const TemporaryFile&) = delete;

  void write(std::size_t offset, Bytes bytes);
  // Ends the writing, so that the file outlasts a power cut.
  void sync();
  // Renames the file, which is synced, over its target, and syncs the folder.
  void replace_target();

 private:
  [[noreturn]] void fail() const;

  std::filesystem::path target_;
  std::string path_;
  int descriptor_ = -1;
  std::size_t offset_ = 0;  // where the descriptor stands
};

}  // namespace protomark
