// The little that these tests need of a test framework: CHECK goes on, main returns the count.
#pragma once

#include <cstdio>
#include <exception>
#include <string>

namespace check {

inline int failures = 0;

inline void report(bool ok, const char* what, const char* file, int line) {
  if (ok) return;
  std::printf("%s:%d: failed: %s\n", file, line, what);
  ++failures;
}

// Whether calling f throws an E whose message contains `part`.
template <typename E, typename F>
bool throws(const F& f, const std::string& part = "") {
  try {
    f();
  } catch (const E& error) {
    if (std::string(error.what()).find(part) != std::string::npos) return true;
    std::printf("message was: %s\n", error.what());
    return false;
  } catch (const std::exception& error) {
    std::printf("another exception: %s\n", error.what());
  }
  return false;
}

inline int result() {
  if (failures == 0) std::printf("ok\n");
  return failures == 0 ? 0 : 1;
}

}  // namespace check

#define CHECK(...) check::report((__VA_ARGS__), #__VA_ARGS__, __FILE__, __LINE__)
