// Which kernels run on this CPU.
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#include "kernels.h"

namespace protomark::kernels {
namespace {

#if defined(__x86_64__)
bool has_avx512() {
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512vnni") &&
         __builtin_cpu_supports("avx512vpopcntdq");
}
#endif

const Kernels& choose() {
  const char* wanted = std::getenv("PROTOMARK_ISA");
  if (wanted != nullptr && *wanted != '\0') {
    if (const Kernels* found = find(wanted)) return *found;
    throw std::invalid_argument("PROTOMARK_ISA=" + std::string(wanted) +
                                ": no such instruction set on this machine; "
                                "leave it unset or use portable");
  }
  if (const Kernels* found = find("avx512")) return *found;
  return portable;
}

}  // namespace

const Kernels* find(const char* name) {
  if (std::strcmp(name, "portable") == 0) return &portable;
#if defined(__x86_64__)
  if (std::strcmp(name, "avx512") == 0 && has_avx512()) return &avx512;
#endif
  return nullptr;
}

const Kernels& active() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace protomark::kernels
