#include "file/disk.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <csignal>
#include <cstring>
#include <ctime>
#include <random>

namespace protomark {
namespace {

// Returns the path of a temporary file beside `target`.
std::filesystem::path beside(const std::filesystem::path& target) {
  constexpr size_t kMaxName = 255;  // bytes
  std::random_device random;
  const std::string suffix = "." + std::to_string(random());
  const std::string name = target.filename().string().substr(0, kMaxName - suffix.size());
  return target.parent_path() / (name + suffix);
}

}  // namespace

std::string system_error() { return std::strerror(errno); }

FileDescriptor FileDescriptor::open_to_read(const std::filesystem::path& path) {
  return FileDescriptor(::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC));
}

FileDescriptor::~FileDescriptor() {
  if (descriptor_ < 0) return;
  const int error = errno;
  ::close(descriptor_);
  errno = error;
}

std::optional<std::vector<std::byte>> FileDescriptor::read(size_t n) const {
  std::vector<std::byte> result(n);
  for (size_t done = 0; done < result.size();) {
    const ssize_t more =
        ::pread(descriptor_, &result[done], result.size() - done, static_cast<off_t>(done));
    if (more < 0 && errno == EINTR) continue;
    if (more < 0) return std::nullopt;
    if (more == 0) result.resize(done);
    done += static_cast<size_t>(more);
  }
  return result;
}

bool FileDescriptor::write(size_t offset, Bytes bytes) const {
  // At a limit on file sizes SIGXFSZ would end the program; while it is blocked, the write fails.
  sigset_t size_signal, before;
  ::sigemptyset(&size_signal);
  ::sigaddset(&size_signal, SIGXFSZ);
  ::pthread_sigmask(SIG_BLOCK, &size_signal, &before);
  ssize_t written = 0;
  while (!bytes.empty()) {
    written = ::pwrite(descriptor_, bytes.data(), bytes.size(), static_cast<off_t>(offset));
    if (written < 0 && errno == EINTR) continue;
    if (written < 0) break;
    bytes = bytes.subspan(static_cast<size_t>(written));
    offset += static_cast<size_t>(written);
  }
  const int error = errno;
  const timespec now{};
  if (written < 0 && error == EFBIG) ::sigtimedwait(&size_signal, nullptr, &now);
  ::pthread_sigmask(SIG_SETMASK, &before, nullptr);
  errno = error;
  return bytes.empty();
}

bool FileDescriptor::is_at(const std::filesystem::path& path) const {
  struct stat open, named;
  return ::fstat(descriptor_, &open) == 0 && ::stat(path.c_str(), &named) == 0 &&
         open.st_dev == named.st_dev && open.st_ino == named.st_ino;
}

std::filesystem::path link_target(std::filesystem::path path) {
  constexpr int kMaxLinks = 40;
  std::error_code error;
  for (int i = 0; i < kMaxLinks && std::filesystem::is_symlink(path, error); ++i) {
    const auto target = std::filesystem::read_symlink(path, error);
    if (error) break;
    path = path.parent_path() / target;
  }
  return path;
}

bool sync_folder(const std::filesystem::path& path) {
  auto folder = path.parent_path();
  if (folder.empty()) folder = ".";
  const FileDescriptor file(::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!file) return true;  // a folder may be writable and yet not readable
  return ::fsync(file.get()) == 0 || errno == EINVAL || errno == ENOTSUP;
}

std::optional<mode_t> permissions(const std::filesystem::path& path) {
  struct stat status;
  if (::stat(path.c_str(), &status) != 0) return std::nullopt;
  return status.st_mode & 0777;
}

TemporaryFile::TemporaryFile(const std::filesystem::path& target)
    : name_(target), target_(link_target(target)) {
  std::error_code error;
  const auto type = std::filesystem::status(target_, error).type();
  using enum std::filesystem::file_type;
  if (type == none) fail_file(name_, "cannot be written: ", error.message());
  if (type != not_found && type != regular) {
    fail_file(name_, "cannot be written: it exists and is not a regular file");
  }
  // Only the owner may read the files of mkstemp.
  const auto mode = permissions(target_);
  do {
    path_ = beside(target_);
    file_ = FileDescriptor(
        ::open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, mode.value_or(0666)));
  } while (!file_ && errno == EEXIST);
  if (!file_) {
    path_.clear();
    fail_write(name_);
  }
  // Restores what the umask removed; if that fails, fewer may read the file, never more.
  if (mode) ::fchmod(file_.get(), *mode);
}

TemporaryFile::~TemporaryFile() {
  if (!path_.empty()) ::unlink(path_.c_str());
}

void TemporaryFile::write(size_t offset, Bytes bytes) {
  if (!file_.write(offset, bytes)) fail_write(name_);
}

void TemporaryFile::sync() {
  if (::fsync(file_.get()) != 0 || ::close(file_.release()) != 0) fail_write(name_);
}

void TemporaryFile::replace_target() {
  if (::rename(path_.c_str(), target_.c_str()) != 0) fail_write(name_);
  path_.clear();
  if (!sync_folder(target_)) {
    fail_file(name_, "is written, but its folder cannot be synced: ", system_error());
  }
}

MappedFile::MappedFile(const std::filesystem::path& path)
    : MappedFile(FileDescriptor::open_to_read(path), path) {}

MappedFile::MappedFile(const FileDescriptor& file, const std::filesystem::path& path) {
  struct stat status;
  if (!file) fail_read(path);
  if (::fstat(file.get(), &status) != 0 || !S_ISREG(status.st_mode)) fail_file(path, "not a file");
  const auto size = static_cast<size_t>(status.st_size);
  if (size == 0) return;
  // The mapping and this descriptor are of one file, whatever becomes of its name.
  file_ = FileDescriptor(::fcntl(file.get(), F_DUPFD_CLOEXEC, 0));
  if (!file_) fail_read(path);
  stamp_ = stamp_of(file_);
  void* data = ::mmap(nullptr, size, PROT_READ, MAP_SHARED, file.get(), 0);
  if (data == MAP_FAILED) fail_read(path);
  bytes_ = {static_cast<const std::byte*>(data), size};
}

std::optional<MappedFile::Stamp> MappedFile::stamp_of(const FileDescriptor& file) {
  struct stat status;
  if (::fstat(file.get(), &status) != 0) return std::nullopt;
#ifdef __APPLE__
  const timespec& changed = status.st_mtimespec;
#else
  const timespec& changed = status.st_mtim;
#endif
  return Stamp{status.st_size, changed.tv_sec, changed.tv_nsec};
}

bool MappedFile::unchanged() const { return bytes_.empty() || stamp_of(file_) == stamp_; }

MappedFile::~MappedFile() {
  if (!bytes_.empty()) ::munmap(const_cast<std::byte*>(bytes_.data()), bytes_.size());
}

}  // namespace protomark
