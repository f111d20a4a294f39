#include "base/parallel.h"

#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <thread>
#include <vector>

#include "check.h"

using namespace protomark;

namespace {

// Whether a loop visits each number once, in ranges of whole grains.
bool covers(int threads, std::size_t n, std::size_t grain) {
  std::vector<std::atomic<int>> visits(n);
  std::atomic<bool> whole = true;
  parallel_for(threads, n, grain, [&](std::size_t begin, std::size_t end) {
    if (begin % grain != 0 || (end % grain != 0 && end != n)) whole = false;
    for (std::size_t i = begin; i < end; ++i) ++visits[i];
  });
  for (const auto& visit : visits) {
    if (visit != 1) return false;
  }
  return whole;
}

// Returns once `n` threads have called it.
void meet(std::atomic<int>& arrived, int n) {
  ++arrived;
  while (arrived < n) std::this_thread::yield();
}

}  // namespace

int main() {
  for (const int threads : {1, 2, 3, 8}) {
    for (const std::size_t n : {0, 1, 5, 16, 1000}) {
      for (const std::size_t grain : {1, 7, 16}) CHECK(covers(threads, n, grain));
    }
  }

  // As many threads as asked for work at once, also after a smaller number did.
  for (const int threads : {2, 5, 3}) {
    std::atomic<int> arrived = 0;
    run_tasks(threads, static_cast<std::size_t>(threads),
              [&](std::size_t) { meet(arrived, threads); });
    CHECK(arrived == threads);
  }

  // A loop within a task runs on the thread of the task.
  std::atomic<int> strangers = 0;
  std::atomic<std::size_t> inner = 0;
  run_tasks(4, 50, [&](std::size_t) {
    const auto self = std::this_thread::get_id();
    parallel_for(4, 30, 1, [&](std::size_t begin, std::size_t end) {
      inner += end - begin;
      if (std::this_thread::get_id() != self) ++strangers;
    });
  });
  CHECK(inner == 50 * 30);
  CHECK(strangers == 0);

  // Several callers at once, each of which gets its own errors.
  {
    std::atomic<int> wrong = 0;
    std::vector<std::jthread> callers;
    for (int caller = 0; caller < 4; ++caller) {
      callers.emplace_back([&, caller] {
        for (int i = 0; i < 200; ++i) {
          if (!covers(3, 40, 3)) ++wrong;
          const auto fails = [&] {
            run_tasks(3, 20, [&](std::size_t task) {
              if (task == 7) throw std::out_of_range("caller " + std::to_string(caller));
            });
          };
          if (!check::throws<std::out_of_range>(fails, std::to_string(caller))) ++wrong;
        }
      });
    }
    callers.clear();
    CHECK(wrong == 0);
  }
  CHECK(covers(4, 100, 1));

#ifndef PROTOMARK_NO_FORK
  // A child process starts its own threads, and exits while they sleep.
  const pid_t child = ::fork();
  if (child == 0) {
    std::atomic<int> arrived = 0;
    run_tasks(2, 2, [&](std::size_t) { meet(arrived, 2); });
    std::exit(covers(3, 100, 1) ? 0 : 1);
  }
  int status = 1;
  CHECK(::waitpid(child, &status, 0) == child);
  CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
#endif

  CHECK(check::throws<std::invalid_argument>([] { covers(0, 1, 1); }, "at least 1"));
  CHECK(check::throws<std::invalid_argument>([] { run_tasks(-1, 1, [](std::size_t) {}); }));
  return check::result();
}
