// Finds the kernels that run on this CPU.
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#if defined(__aarch64__) && defined(__linux__)
#include <sys/auxv.h>
#elif defined(__x86_64__)
#include <cpuid.h>
#if defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif
#endif

#include "base/text.h"
#include "kernels/kernels.h"
#include "protomark/types.h"

namespace protomark::kernels {
namespace {

#if defined(__x86_64__)
bool has_avx2() { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt"); }

bool has_avx512() {
  return has_avx2() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512vbmi") &&
         __builtin_cpu_supports("avx512vnni") && __builtin_cpu_supports("avx512vpopcntdq");
}

#if defined(PROTOMARK_HAS_AMX) && defined(__linux__)
// A process must ask Linux for room for tiles. Elsewhere AMX is not used.
bool has_amx() {
  constexpr unsigned kTile = 1u << 24, kInt8 = 1u << 25;
  unsigned a = 0, b = 0, c = 0, d = 0;
  if (!has_avx512() || __get_cpuid_count(7, 0, &a, &b, &c, &d) == 0) return false;
  if ((d & kTile) == 0 || (d & kInt8) == 0) return false;
  constexpr long kRequestPermission = 0x1023;  // ARCH_REQ_XCOMP_PERM
  constexpr long kTileData = 18;               // XFEATURE_XTILEDATA
  return syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
}
#endif
#elif defined(__aarch64__)
bool has_dot_product() {
#if defined(__APPLE__)
  return true;
#elif defined(__linux__)
  constexpr unsigned long kAsimdDotProduct = 1ul << 20;  // HWCAP_ASIMDDP
  return (getauxval(AT_HWCAP) & kAsimdDotProduct) != 0;
#else
  return false;
#endif
}
#endif

std::vector<Kernels> find_all() {
  std::vector<Kernels> found;
#if defined(__x86_64__)
#if defined(PROTOMARK_HAS_AMX) && defined(__linux__)
  if (has_amx()) {
    found.push_back(avx512);
    found.back().name = amx.name;
    found.back().code_scan = amx.code_scan;
  }
#endif
  if (has_avx512()) found.push_back(avx512);
  if (has_avx2()) found.push_back(avx2);
#elif defined(__aarch64__)
  if (has_dot_product()) found.push_back(neon);
#endif
  found.push_back(portable);
  found.push_back({});
  return found;
}

const Kernels& choose() {
  const char* name = std::getenv("PROTOMARK_ISA");
  if (name == nullptr || *name == '\0') return *all();
  if (const Kernels* found = find(name)) return *found;
  std::string available;
  for (const Kernels* set = all(); set->name != nullptr; ++set) {
    available += (available.empty() ? "" : ", ") + std::string(set->name);
  }
  invalid("PROTOMARK_ISA=", name,
          ": no such instruction set on this machine; leave it unset or use ", available);
}

}  // namespace

const Kernels* all() {
  static const std::vector<Kernels> found = find_all();
  return found.data();
}

const Kernels* find(const char* name) {
  const Kernels* set = all();
  while (set->name != nullptr && std::strcmp(set->name, name) != 0) ++set;
  return set->name != nullptr ? set : nullptr;
}

const Kernels& active() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace protomark::kernels

const char* protomark::instruction_set() { return kernels::active().name; }
