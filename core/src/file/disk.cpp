#include "file/disk.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <random>
#include <utility>

#include "protomark/error.h"

namespace protomark {

std::string system_error() { return std::strerror(errno); }

bool write_all(int descriptor, Bytes bytes) {
  while (!bytes.empty()) {
    const ssize_t written = ::write(descriptor, bytes.data(), bytes.size());
    if (written < 0 && errno == EINTR) continue;
    if (written < 0) return false;
    bytes = bytes.subspan(static_cast<std::size_t>(written));
  }
  return true;
}

bool sync_folder(const std::filesystem::path& path) {
  auto folder = path.parent_path();
  if (folder.empty()) folder = ".";
  const int descriptor = ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (descriptor < 0) return true;  // a folder may be writable and yet not readable
  const bool synced = ::fsync(descriptor) == 0 || errno == EINVAL || errno == ENOTSUP;
  const int error = errno;
  ::close(descriptor);
  errno = error;
  return synced;
}

std::optional<mode_t> permissions(const std::filesystem::path& path) {
  struct stat status;
  if (::stat(path.c_str(), &status) != 0) return std::nullopt;
  return status.st_mode & 0777;
}

TemporaryFile::TemporaryFile(const std::filesystem::path& target) : target_(target) {
  // Not mkstemp, whose files only their owner may read: a map is as readable as any file.
  const auto mode = permissions(target);
  std::random_device random;
  do {
    path_ = target.string() + "." + std::to_string(random());
    descriptor_ =
        ::open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, mode.value_or(0666));
  } while (descriptor_ < 0 && errno == EEXIST);
  if (descriptor_ < 0) {
    path_.clear();
    fail();
  }
  // What the umask took away; where that fails, fewer may read the file, never more.
  if (mode) ::fchmod(descriptor_, *mode);
}

TemporaryFile::~TemporaryFile() {
  if (descriptor_ >= 0) ::close(descriptor_);
  if (!path_.empty()) ::unlink(path_.c_str());
}

void TemporaryFile::write(std::size_t offset, Bytes bytes) {
  if (bytes.empty()) return;
  if (offset != offset_ && ::lseek(descriptor_, static_cast<off_t>(offset), SEEK_SET) < 0) fail();
  if (!write_all(descriptor_, bytes)) fail();
  offset_ = offset + bytes.size();
}

void TemporaryFile::sync() {
  if (::fsync(descriptor_) != 0) fail();
  const int descriptor = std::exchange(descriptor_, -1);
  if (::close(descriptor) != 0) fail();
}

void TemporaryFile::replace_target() {
  if (::rename(path_.c_str(), target_.c_str()) != 0) fail();
  path_.clear();
  if (!sync_folder(target_)) {
    throw FileError(target_.string() +
                    ": is written, but its folder cannot be synced: " + system_error());
  }
}

void TemporaryFile::fail() const {
  throw FileError(target_.string() + ": cannot be written: " + system_error());
}

}  // namespace protomark
