// Loops whose work the threads of one pool share.
#pragma once

#include <algorithm>
#include <cstddef>
#include <functional>

namespace protomark {

// Calls task(0) to task(n - 1) on up to `threads` threads, the caller's among them. A task that
// calls this runs the inner tasks by itself. After an exception no further task begins, and the
// first exception is rethrown. Several threads may call this at once, and so may a child of fork().
void run_tasks(int threads, size_t n, const std::function<void(size_t)>& task);

struct Range {
  size_t begin;
  size_t end;
  size_t size() const { return end - begin; }
};

// Returns the i-th of n elements' `ranges` ranges, all but the last with a multiple of `grain`.
inline Range range_of(size_t n, size_t ranges, size_t i, size_t grain) {
  const size_t grains = (n + grain - 1) / grain;
  return {std::min(n, grains * i / ranges * grain), std::min(n, grains * (i + 1) / ranges * grain)};
}

// Calls body(begin, end) for ranges of [0, n), all but the last of a multiple of `grain` elements.
void parallel_for(int threads, size_t n, size_t grain, const auto& body) {
  if (threads == 1 && n > 0) return body(size_t{0}, n);
  // With several ranges per thread, others take over from a thread that is held up.
  const size_t ranges = std::min((n + grain - 1) / grain, 4 * static_cast<size_t>(threads));
  run_tasks(threads, ranges, [&](size_t i) {
    const Range range = range_of(n, ranges, i, grain);
    body(range.begin, range.end);
  });
}

}  // namespace protomark
