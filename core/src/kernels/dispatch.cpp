// Which kernels run on this CPU.
#include <algorithm>
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
#include "protomark/instruction_set.h"

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
// Linux gives a process the room that tiles need when it asks for it. Elsewhere AMX is not used.
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

// What `set` does and, for what it leaves out, what `below` does.
Kernels over(const Kernels& set, const Kernels& below) {
  Kernels result = below;
  result.name = set.name;
  const auto take = [](auto& mine, auto theirs) {
    if (theirs != nullptr) mine = theirs;
  };
  take(result.bit_sums, set.bit_sums);
  take(result.bit_sum, set.bit_sum);
  take(result.dense, set.dense);
  take(result.activate16, set.activate16);
  take(result.activate32, set.activate32);
  take(result.code_biases, set.code_biases);
  take(result.code_unpack4, set.code_unpack4);
  take(result.code_scan, set.code_scan);
  take(result.hamming_scan, set.hamming_scan);
  return result;
}

// All that run here, complete, best first.
struct Sets {
  std::array<Kernels, 4> kernels;
  std::array<const char*, 5> names{};
  std::size_t size = 0;

  Sets() {
    add(portable);
#if defined(__x86_64__)
    if (has_avx2()) add(avx2);
    if (has_avx512()) add(avx512);
#if defined(PROTOMARK_HAS_AMX) && defined(__linux__)
    if (has_amx()) add(amx);
#endif
#elif defined(__aarch64__)
    if (has_dot_product()) add(neon);
#endif
    std::reverse(kernels.begin(), kernels.begin() + size);
    for (std::size_t i = 0; i < size; ++i) names[i] = kernels[i].name;
  }

  void add(const Kernels& set) {
    kernels[size] = size == 0 ? set : over(set, kernels[size - 1]);
    ++size;
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
  std::string known;
  for (const char* const* name = names(); *name != nullptr; ++name) {
    known += (known.empty() ? "" : ", ") + std::string(*name);
  }
  throw std::invalid_argument("PROTOMARK_ISA=" + std::string(wanted) +
                              ": no such instruction set on this machine; leave it unset or use " +
                              known);
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

namespace protomark {

const char* instruction_set() { return kernels::active().name; }

}  // namespace protomark
