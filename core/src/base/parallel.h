// A loop over ranges on the threads of one pool.
#pragma once

#include <algorithm>
#include <cstddef>
#include <functional>
#include <stdexcept>

namespace protomark {

// Calls task(0) to task(n - 1) on up to `threads` threads, one of which is the caller's. Threads
// are started when they are first needed and stay. A task that calls this runs its tasks itself.
// After an exception no task is begun any more; the first one is rethrown. May be called from
// several threads at once, and after fork(), which leaves the child without threads to start with.
void run_tasks(int threads, std::size_t n, const std::function<void(std::size_t)>& task);

// Calls body(begin, end) for ranges that cover [0, n) once, on up to `threads` threads, each range
// a multiple of `grain` but the last.
template <typename Body>
void parallel_for(int threads, std::size_t n, std::size_t grain, const Body& body) {
  if (threads < 1) throw std::invalid_argument("threads must be at least 1");
  if (n == 0) return;
  const std::size_t grains = (n + grain - 1) / grain;
  if (threads == 1 || grains == 1) {
    body(std::size_t{0}, n);
    return;
  }
  // A few for each thread, so that one that is held up leaves its share to the others.
  const std::size_t ranges = std::min(grains, 4 * static_cast<std::size_t>(threads));
  run_tasks(threads, ranges, [&](std::size_t i) {
    body(grains * i / ranges * grain, std::min(n, grains * (i + 1) / ranges * grain));
  });
}

}  // namespace protomark
