// A lock for many readers or one writer that serves threads in the order in which they came.
#pragma once

#include <atomic>
#include <cstdint>
#include <shared_mutex>

namespace protomark {

// A writer would wait for glibc's std::shared_mutex for ever while a few threads search in turns.
class FairSharedMutex {
 public:
  void lock() {
    enter();
    mutex_.lock();
    leave();
  }
  void lock_shared() {
    enter();
    mutex_.lock_shared();
    leave();
  }
  // Fails if any thread is waiting.
  bool try_lock_shared() {
    uint32_t ticket = serving_.load();
    if (!next_.compare_exchange_strong(ticket, ticket + 1)) return false;
    const bool locked = mutex_.try_lock_shared();
    leave();
    return locked;
  }
  void unlock() { mutex_.unlock(); }
  void unlock_shared() { mutex_.unlock_shared(); }

 private:
  // One thread at a time waits at the mutex, the others wait for their ticket.
  void enter() {
    const uint32_t ticket = next_.fetch_add(1);
    for (uint32_t now = serving_.load(); now != ticket; now = serving_.load()) {
      serving_.wait(now);
    }
  }
  void leave() {
    serving_.fetch_add(1);
    serving_.notify_all();
  }

  std::shared_mutex mutex_;
  std::atomic<uint32_t> next_ = 0;
  std::atomic<uint32_t> serving_ = 0;
};

}  // namespace protomark
