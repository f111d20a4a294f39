// Which kernels run on this CPU.
#include <array>
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#if defined(__aarch64__) && defined(__linux__)
#include <sys/auxv.h>
#elif defined(__x86_64__)
#include <cpuid.h>
#if defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif
#endif

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
// Linux gives a process room for tiles if it asks for it. Elsewhere AMX is not used.
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

// All that run here, best first.
struct Sets {
  std::array<Kernels, 4> kernels;
  std::array<const char*, 5> names{};
  std::size_t size = 0;

  Sets() {
#if defined(__x86_64__)
#if defined(PROTOMARK_HAS_AMX) && defined(__linux__)
    if (has_amx()) {
      Kernels set = avx512;
      set.name = amx.name;
      set.code_scan = amx.code_scan;
      add(set);
    }
#endif
    if (has_avx512()) add(avx512);
    if (has_avx2()) add(avx2);
#elif defined(__aarch64__)
    if (has_dot_product()) add(neon);
#endif
    add(portable);
  }

  void add(const Kernels& set) {
    kernels[size] = set;
    names[size++] = set.name;
  }
};

const Sets& sets() {
  static const Sets found;
  return found;
}

const Kernels& choose() {
  const char* wanted = std::getenv("PROTOMARK_ISA");
  if (wanted == nullptr || *wanted == '\0') return sets().kernels.front();
  if (const Kernels* found = find(wanted)) return *found;
  std::string available;
  for (const char* const* name = names(); *name != nullptr; ++name) {
    available += (available.empty() ? "" : ", ") + std::string(*name);
  }
  throw std::invalid_argument("PROTOMARK_ISA=" + std::string(wanted) +
                              ": no such instruction set on this machine; leave it unset or use " +
                              available);
}

}  // namespace

const Kernels* find(const char* name) {
  for (std::size_t i = 0; i < sets().size; ++i) {
    if (std::strcmp(sets().names[i], name) == 0) return &sets().kernels[i];
  }
  return nullptr;
}

const char* const* names() { return sets().names.data(); }

const Kernels& active() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace protomark::kernels

const char* protomark::instruction_set() { return kernels::active().name; }
