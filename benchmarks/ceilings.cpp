// The Python module protomark_bench._ceilings: what one thread of this machine can do at most.
// Instruction sets are chosen function by function, so the file needs no compile flags.
#include <nanobind/nanobind.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <map>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>

#if defined(__linux__)
#include <sys/mman.h>
#endif
#if defined(__x86_64__)
#include <immintrin.h>
#if defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif
#elif defined(__aarch64__)
#include <arm_neon.h>
#if defined(__linux__)
#include <sys/auxv.h>
#endif
#endif

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// Twelve sums at a time: enough to hide the latency of a product, few enough to stay in registers.
constexpr int kSums = 12;
constexpr std::size_t kRounds = 100'000;

double seconds_of(std::size_t (*work)()) {
  const auto began = std::chrono::steady_clock::now();
  work();
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
}

// Multiply-adds per second, the best of the runs that fit into `seconds`; `work` returns how many
// it did.
double best_rate(std::size_t (*work)(), double seconds) {
  const std::size_t done = work();
  double best = seconds_of(work);
  for (double spent = best; spent < seconds;) {
    const double now = seconds_of(work);
    best = std::min(best, now);
    spent += now;
  }
  return static_cast<double>(done) / best;
}

#if defined(__x86_64__)

// An empty statement that the compiler must take for a change of x.
#define PROTOMARK_OPAQUE(x) __asm__ volatile("" : "+x"(x))

__attribute__((target("avx2"))) std::size_t avx2_products() {
  __m256i a = _mm256_set1_epi8(1);
  __m256i b = _mm256_set1_epi8(1);
  const __m256i ones = _mm256_set1_epi16(1);
  __m256i sums[kSums] = {};
  for (std::size_t i = 0; i < kRounds; ++i) {
    PROTOMARK_OPAQUE(a);
    PROTOMARK_OPAQUE(b);
#pragma GCC unroll 12
    for (int j = 0; j < kSums; ++j) {
      // Another operand each time, or one product would serve all sums.
      PROTOMARK_OPAQUE(b);
      const __m256i pairs = _mm256_maddubs_epi16(a, b);
      sums[j] = _mm256_add_epi32(sums[j], _mm256_madd_epi16(pairs, ones));
    }
  }
  for (auto& sum : sums) PROTOMARK_OPAQUE(sum);
  return kRounds * kSums * 32;
}

__attribute__((target("avx512f,avx512vnni"))) std::size_t vnni_products() {
  __m512i a = _mm512_set1_epi8(1);
  __m512i b = _mm512_set1_epi8(1);
  __m512i sums[kSums] = {};
  // Sums that are equal to the compiler would become one.
  for (auto& sum : sums) __asm__ volatile("" : "+v"(sum));
  for (std::size_t i = 0; i < kRounds; ++i) {
    __asm__ volatile("" : "+v"(a), "+v"(b));
#pragma GCC unroll 12
    for (int j = 0; j < kSums; ++j) sums[j] = _mm512_dpbusd_epi32(sums[j], a, b);
  }
  for (auto& sum : sums) __asm__ volatile("" : "+v"(sum));
  return kRounds * kSums * 64;
}

__attribute__((target("avx2"))) std::uint64_t read(const std::byte* data, std::size_t size) {
  __m256i sums[8] = {};
  for (std::size_t i = 0; i + 256 <= size; i += 256) {
#pragma GCC unroll 8
    for (int j = 0; j < 8; ++j) {
      const void* at = data + i + 32 * j;
      sums[j] = _mm256_xor_si256(sums[j], _mm256_loadu_si256(static_cast<const __m256i*>(at)));
    }
  }
  for (int j = 1; j < 8; ++j) sums[0] = _mm256_xor_si256(sums[0], sums[j]);
  return static_cast<std::uint64_t>(_mm256_extract_epi64(sums[0], 0));
}

#if defined(__linux__)
struct alignas(64) TileShapes {
  std::uint8_t palette = 1;
  std::uint8_t start = 0;
  std::uint8_t reserved[14] = {};
  std::uint16_t bytes[16] = {};
  std::uint8_t rows[16] = {};
};

__attribute__((target("amx-tile,amx-int8"))) std::size_t amx_products() {
  TileShapes shapes;
  for (int t = 0; t < 8; ++t) {
    shapes.bytes[t] = 64;
    shapes.rows[t] = 16;
  }
  // GCC's _tile_loadconfig does not say that it reads memory, so the shapes might not be written.
  __asm__ volatile("ldtilecfg %0" : : "m"(shapes));
  for (std::size_t i = 0; i < kRounds / 16; ++i) {
    _tile_dpbusd(0, 4, 6);
    _tile_dpbusd(1, 4, 7);
    _tile_dpbusd(2, 5, 6);
    _tile_dpbusd(3, 5, 7);
  }
  _tile_release();
  return kRounds / 16 * 4 * (16 * 16 * 64);
}

// Linux gives the tiles only to a process that asks for them.
bool may_use_tiles() {
  constexpr long kRequestPermission = 0x1023;  // ARCH_REQ_XCOMP_PERM
  constexpr long kTileData = 18;               // XFEATURE_XTILEDATA
  return syscall(SYS_arch_prctl, kRequestPermission, kTileData) == 0;
}
#endif

std::map<std::string, double> multiply_adds(double seconds) {
  std::map<std::string, double> rates;
  if (__builtin_cpu_supports("avx2")) rates["avx2"] = best_rate(avx2_products, seconds);
  if (__builtin_cpu_supports("avx512vnni")) rates["avx512"] = best_rate(vnni_products, seconds);
#if defined(__linux__)
  if (__builtin_cpu_supports("amx-tile") && __builtin_cpu_supports("amx-int8") && may_use_tiles()) {
    rates["amx"] = best_rate(amx_products, seconds);
  }
#endif
  return rates;
}

bool can_read() { return __builtin_cpu_supports("avx2"); }

#else

#if defined(__aarch64__)
__attribute__((target("arch=armv8.2-a+dotprod"))) std::size_t neon_products() {
  int8x16_t a = vdupq_n_s8(1);
  int8x16_t b = vdupq_n_s8(1);
  int32x4_t sums[kSums] = {};
  for (auto& sum : sums) __asm__ volatile("" : "+w"(sum));
  for (std::size_t i = 0; i < kRounds; ++i) {
    __asm__ volatile("" : "+w"(a), "+w"(b));
#pragma GCC unroll 12
    for (int j = 0; j < kSums; ++j) sums[j] = vdotq_s32(sums[j], a, b);
  }
  for (auto& sum : sums) __asm__ volatile("" : "+w"(sum));
  return kRounds * kSums * 16;
}

bool has_dot_product() {
#if defined(__linux__)
  constexpr unsigned long kAsimdDotProduct = 1ul << 20;  // HWCAP_ASIMDDP
  return (getauxval(AT_HWCAP) & kAsimdDotProduct) != 0;
#else
  return true;
#endif
}
#endif

std::map<std::string, double> multiply_adds(double seconds) {
  std::map<std::string, double> rates;
#if defined(__aarch64__)
  if (has_dot_product()) rates["neon"] = best_rate(neon_products, seconds);
#else
  (void)seconds;
#endif
  return rates;
}

bool can_read() { return false; }
std::uint64_t read(const std::byte*, std::size_t) { return 0; }

#endif

std::uint64_t plain_read(const std::byte* data, std::size_t size) {
  const auto* words = reinterpret_cast<const std::uint64_t*>(data);
  std::uint64_t sums[8] = {};
  for (std::size_t i = 0; i + 8 <= size / 8; i += 8) {
    for (int j = 0; j < 8; ++j) sums[j] ^= words[i + j];
  }
  for (int j = 1; j < 8; ++j) sums[0] ^= sums[j];
  return sums[0];
}

struct Free {
  void operator()(std::byte* data) const { std::free(data); }
};

// In large pages where the system has them, as maps are: with small ones, translating addresses
// limits reading before memory does.
std::unique_ptr<std::byte, Free> buffer_of(std::size_t size) {
  constexpr std::size_t kLargePage = std::size_t{1} << 21;
  const std::size_t whole = (size + kLargePage - 1) / kLargePage * kLargePage;
  std::unique_ptr<std::byte, Free> buffer(
      static_cast<std::byte*>(std::aligned_alloc(kLargePage, whole)));
  if (!buffer) throw std::bad_alloc();
#if defined(__linux__)
  madvise(buffer.get(), whole, MADV_HUGEPAGE);
#endif
  std::memset(buffer.get(), 1, whole);
  return buffer;
}

double read_bytes(std::size_t size, double seconds) {
  if (size < 4096) throw std::invalid_argument("read_bytes: at least 4096 bytes are needed");
  const auto buffer = buffer_of(size);
  const std::byte* data = buffer.get();
  double best = 0;
  double spent = 0;
  do {
    const auto began = std::chrono::steady_clock::now();
    volatile std::uint64_t result = can_read() ? read(data, size) : plain_read(data, size);
    (void)result;
    const std::chrono::duration<double> now = std::chrono::steady_clock::now() - began;
    best = std::max(best, static_cast<double>(size) / now.count());
    spent += now.count();
  } while (spent < seconds);
  return best;
}

}  // namespace

NB_MODULE(_ceilings, m) {
  m.doc() = "What one thread of this machine can do at most.";
  m.def("multiply_adds", &multiply_adds, "seconds"_a = 0.2,
        nb::call_guard<nb::gil_scoped_release>(),
        "int8 multiply-adds per second of one thread, from registers, for each of avx2, avx512 "
        "(VNNI), amx and neon that this CPU has. Runs about `seconds` each.");
  m.def("read_bytes", &read_bytes, "size"_a, "seconds"_a = 0.2,
        nb::call_guard<nb::gil_scoped_release>(),
        "Bytes per second that one thread reads, in order, from a buffer of `size` bytes in "
        "large pages where the system has them.");
}
