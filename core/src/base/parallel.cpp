#include "base/parallel.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <mutex>
#include <system_error>
#include <thread>

#include "base/text.h"

namespace protomark {
namespace {

// Threads stay once started; a mistyped number must not start thousands.
constexpr size_t kMaxThreads = 256;

thread_local bool inside_task = false;

struct Job {
  const std::function<void(size_t)>& task;
  size_t n;
  size_t helpers_wanted;
  std::atomic<size_t> next = 0;
  // Guarded by the pool's mutex.
  size_t helpers_at_work = 0;
  std::exception_ptr error = nullptr;
};

class Pool {
 public:
  const pid_t process = ::getpid();

  void run(Job& job) {
    {
      const std::scoped_lock lock(mutex_);
      start_threads(job.helpers_wanted);
      jobs_.push_back(&job);
    }
    wake_.notify_all();
    work_on(job);
    std::unique_lock lock(mutex_);
    std::erase(jobs_, &job);
    done_.wait(lock, [&] { return job.helpers_at_work == 0; });
  }

 private:
  void start_threads(size_t n) {
    try {
      for (; threads_ < n; ++threads_) std::thread([this] { help(); }).detach();
    } catch (const std::system_error&) {
      return;  // the system gives no more threads: those that exist do the work
    }
  }

  [[noreturn]] void help() {
    std::unique_lock lock(mutex_);
    while (true) {
      wake_.wait(lock, [&] { return !jobs_.empty(); });
      Job& job = *jobs_.front();
      ++job.helpers_at_work;
      if (--job.helpers_wanted == 0) jobs_.pop_front();
      lock.unlock();
      work_on(job);
      lock.lock();
      if (--job.helpers_at_work == 0) done_.notify_all();
    }
  }

  void work_on(Job& job) {
    inside_task = true;
    for (size_t i; (i = job.next.fetch_add(1)) < job.n;) {
      try {
        job.task(i);
      } catch (...) {
        job.next = job.n;
        const std::scoped_lock lock(mutex_);
        if (!job.error) job.error = std::current_exception();
      }
    }
    inside_task = false;
  }

  std::mutex mutex_;
  std::condition_variable wake_, done_;
  std::deque<Job*> jobs_;  // those that still want helpers
  size_t threads_ = 0;
};

// The pool is never destroyed, as its detached threads sleep in it at exit. A child of fork() makes
// a pool of its own: its copy of the parent's has no threads and may be locked.
Pool& pool() {
  static std::atomic<Pool*> shared = nullptr;
  Pool* current = shared.load();
  while (current == nullptr || current->process != ::getpid()) {
    auto* fresh = new Pool;
    if (shared.compare_exchange_strong(current, fresh)) return *fresh;
    delete fresh;
  }
  return *current;
}

}  // namespace

void run_tasks(int threads, size_t n, const std::function<void(size_t)>& task) {
  require(threads >= 1, "threads must be at least 1");
  const size_t workers = std::min({static_cast<size_t>(threads), n, kMaxThreads});
  if (workers <= 1 || inside_task) {
    for (size_t i = 0; i < n; ++i) task(i);
    return;
  }
  Job job{task, n, workers - 1};
  pool().run(job);
  if (job.error) std::rethrow_exception(job.error);
}

}  // namespace protomark
