// A loop over ranges on several threads.
#pragma once

#include <algorithm>
#include <cstddef>
#include <exception>
#include <stdexcept>
#include <thread>
#include <vector>

namespace protomark {

// Calls body(begin, end) for ranges that cover [0, n) once, on up to `threads` threads, each range
// a multiple of `grain` but the last. Rethrows the first exception.
template <typename Body>
void parallel_for(int threads, std::size_t n, std::size_t grain, const Body& body) {
  if (threads < 1) throw std::invalid_argument("threads must be at least 1");
  if (n == 0) return;
  const std::size_t grains = (n + grain - 1) / grain;
  const std::size_t workers = std::min<std::size_t>(static_cast<std::size_t>(threads), grains);
  if (workers == 1) {
    body(std::size_t{0}, n);
    return;
  }
  std::vector<std::exception_ptr> errors(workers);
  const auto work = [&](std::size_t w) {
    const std::size_t begin = grains * w / workers * grain;
    const std::size_t end = std::min(n, grains * (w + 1) / workers * grain);
    try {
      body(begin, end);
    } catch (...) {
      errors[w] = std::current_exception();
    }
  };
  {
    std::vector<std::jthread> pool;
    pool.reserve(workers - 1);
    for (std::size_t w = 1; w < workers; ++w) pool.emplace_back(work, w);
    work(0);
  }
  for (const auto& error : errors) {
    if (error) std::rethrow_exception(error);
  }
}

}  // namespace protomark
