// What a program does to the disk, in which order, and steps of it that fail. The system calls of a
// test that includes this go through here.
#pragma once

#include <fcntl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <functional>
#include <string>
#include <vector>

namespace {

struct Disk {
  std::vector<std::string> calls;
  long room = -1;           // bytes until the disk is full; -1: never
  long write_at_most = -1;  // bytes that one call writes, which a signal interrupts each time
  int fsync_file = 0, fsync_folder = 0, rename = 0;  // errno of each; 0: it works
  bool interrupted = false;

  // The step of this number fails, with this errno, and all later ones where `broken`.
  long fails_at = -1;
  int error = EIO;
  bool broken = false;
  long steps = 0;
  std::function<void()> before_step;  // and in the middle of a write
  std::function<void(int descriptor, bool folder)> after_sync;
} disk;

int failed(int error) {
  errno = error;
  return -1;
}

// Counts a step; false where it fails.
bool step() {
  if (disk.before_step) disk.before_step();
  const long number = disk.steps++;
  const bool fails =
      disk.fails_at >= 0 && (number == disk.fails_at || (disk.broken && number > disk.fails_at));
  if (fails) errno = disk.error;
  return !fails;
}

}  // namespace

extern "C" ssize_t pwrite(int descriptor, const void* data, std::size_t size, off_t offset) {
  if (disk.write_at_most >= 0) {
    disk.interrupted = !disk.interrupted;
    if (disk.interrupted) return failed(EINTR);
    size = std::min(size, static_cast<std::size_t>(disk.write_at_most));
  }
  if (disk.room >= 0) {
    if (disk.room == 0 && size > 0) return failed(ENOSPC);
    size = std::min(size, static_cast<std::size_t>(disk.room));
    disk.room -= static_cast<long>(size);
  }
  if (!step()) {
    // What fails may have gone half-way.
    if (syscall(SYS_pwrite64, descriptor, data, size / 2, offset) < 0) return -1;
    return failed(disk.error);
  }
  if (!disk.before_step || size < 2) {
    return syscall(SYS_pwrite64, descriptor, data, size, offset);
  }
  const ssize_t half = syscall(SYS_pwrite64, descriptor, data, size / 2, offset);
  disk.before_step();
  return half;
}

extern "C" int fsync(int descriptor) {
  struct stat status;
  ::fstat(descriptor, &status);
  const bool folder = S_ISDIR(status.st_mode);
  disk.calls.emplace_back(folder ? "sync folder" : "sync file");
  if (!step()) return -1;
  const int error = folder ? disk.fsync_folder : disk.fsync_file;
  if (error != 0) return failed(error);
  const auto result = static_cast<int>(syscall(SYS_fsync, descriptor));
  if (disk.after_sync) disk.after_sync(descriptor, folder);
  return result;
}

extern "C" int rename(const char* from, const char* to) noexcept {
  disk.calls.emplace_back("rename");
  if (!step()) return -1;
  if (disk.rename != 0) return failed(disk.rename);
  return static_cast<int>(syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0));
}

extern "C" int ftruncate(int descriptor, off_t size) noexcept {
  disk.calls.emplace_back("cut");
  if (!step()) return -1;
  return static_cast<int>(syscall(SYS_ftruncate, descriptor, size));
}
