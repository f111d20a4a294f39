// NEON with dot products (ARMv8.2 and later): phones since 2018, Apple silicon, Graviton 2.
#include <arm_neon.h>

#include "kernels/generic_encoder.h"
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

// Bit r of the result is set where lane r is, of 16 lanes of 32 bits or 8 of 64 bits.
unsigned bits_of(uint32x4_t a, uint32x4_t b, uint32x4_t c, uint32x4_t d) {
  const uint8x16_t lanes = vcombine_u8(vmovn_u16(vcombine_u16(vmovn_u32(a), vmovn_u32(b))),
                                       vmovn_u16(vcombine_u16(vmovn_u32(c), vmovn_u32(d))));
  const uint8x16_t weights = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
  const uint8x16_t bits = vandq_u8(lanes, weights);
  return vaddv_u8(vget_low_u8(bits)) | static_cast<unsigned>(vaddv_u8(vget_high_u8(bits))) << 8;
}

struct Neon {
  struct Sums16 {
    int16x8_t v[4];
  };
  static constexpr std::size_t kSums16 = 32;
  static Sums16 zero16() { return {}; }
  static Sums16 load16(const std::int16_t* sums) {
    return {vld1q_s16(sums), vld1q_s16(sums + 8), vld1q_s16(sums + 16), vld1q_s16(sums + 24)};
  }
  static Sums16 widen(const std::int8_t* w) {
    return {vmovl_s8(vld1_s8(w)), vmovl_s8(vld1_s8(w + 8)), vmovl_s8(vld1_s8(w + 16)),
            vmovl_s8(vld1_s8(w + 24))};
  }
  static Sums16 add16(const Sums16& a, const Sums16& b) {
    return {vaddq_s16(a.v[0], b.v[0]), vaddq_s16(a.v[1], b.v[1]), vaddq_s16(a.v[2], b.v[2]),
            vaddq_s16(a.v[3], b.v[3])};
  }
  static void store16(std::int16_t* sums, const Sums16& a) {
    for (int i = 0; i < 4; ++i) vst1q_s16(sums + 8 * i, a.v[i]);
  }

  struct Sums {
    int32x4_t v[4];
  };
  static Sums zero() { return {}; }
  static Sums load(const std::int32_t* sums) {
    return {vld1q_s32(sums), vld1q_s32(sums + 4), vld1q_s32(sums + 8), vld1q_s32(sums + 12)};
  }
  static void store(std::int32_t* sums, const Sums& a) {
    for (int i = 0; i < 4; ++i) vst1q_s32(sums + 4 * i, a.v[i]);
  }
  static Sums add(const Sums& a, const Sums& b) {
    return {vaddq_s32(a.v[0], b.v[0]), vaddq_s32(a.v[1], b.v[1]), vaddq_s32(a.v[2], b.v[2]),
            vaddq_s32(a.v[3], b.v[3])};
  }
  static Sums half(const Sums& a) {
    return {vshrq_n_s32(a.v[0], 1), vshrq_n_s32(a.v[1], 1), vshrq_n_s32(a.v[2], 1),
            vshrq_n_s32(a.v[3], 1)};
  }

  struct Codes {
    int8x16_t v[4];
  };
  static Codes load_codes(const std::int8_t* codes) {
    return {vld1q_s8(codes), vld1q_s8(codes + 16), vld1q_s8(codes + 32), vld1q_s8(codes + 48)};
  }
  static void dot(Sums& sums, int8x16_t q, const Codes& codes) {
    for (int i = 0; i < 4; ++i) sums.v[i] = vdotq_s32(sums.v[i], codes.v[i], q);
  }

  // Both factors of vdot have a sign, so queries lose the 128 that was added.
  struct Step {
    std::int8_t codes[4];
  };
  static const Step* steps(const std::uint8_t* codes, std::size_t n, Step* room) {
    for (std::size_t i = 0; i < 4 * n; ++i) {
      room[i / 4].codes[i % 4] = static_cast<std::int8_t>(codes[i] - 128);
    }
    return room;
  }
  static int8x16_t broadcast(const Step& step) {
    return vreinterpretq_s8_s32(vdupq_n_s32(__builtin_bit_cast(std::int32_t, step)));
  }

  static constexpr int kDenseBatch = 4;
  static constexpr std::size_t kLanes = 4;
  static constexpr int kDenseGroups = 1;
  using Inputs = int8x16_t;
  static Inputs inputs(const std::uint8_t* x) {
    return vreinterpretq_s8_u8(veorq_u8(vld1q_u8(x), vdupq_n_u8(128)));
  }
  template <int Lane>
  static void dot_lane(Sums& sums, Inputs x, const Codes& weights) {
    for (int i = 0; i < 4; ++i) sums.v[i] = vdotq_laneq_s32(sums.v[i], weights.v[i], x, Lane);
  }
  // What the inputs lose with the 128.
  static Sums dense_start(const std::int8_t* weights, std::size_t inputs) {
    Sums sums = zero();
    for (std::size_t j = 0; j < inputs; j += 4) {
      dot(sums, vdupq_n_s8(1), load_codes(weights + 16 * j));
    }
    for (int32x4_t& part : sums.v) part = vshlq_n_s32(part, 7);
    return sums;
  }

  static constexpr std::size_t kInts = 4;
  using Ints = int32x4_t;
  static Ints load_ints(const std::int32_t* sums) { return vld1q_s32(sums); }
  static Ints load_ints(const std::int16_t* sums) { return vmovl_s16(vld1_s16(sums)); }
  struct Factors {
    int32x4_t bias, multipliers;
  };
  static Factors factors(const std::int32_t* bias, const std::int32_t* multipliers) {
    return {vld1q_s32(bias), vld1q_s32(multipliers)};
  }
  struct Rounding {
    int64x2_t half;
    int32x4_t shift;
  };
  static Rounding rounding(int shift) {
    return {vdupq_n_s64(std::int64_t{1} << (shift - 1)), vdupq_n_s32(32 - shift)};
  }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, const Factors& f, const Rounding& r) {
    const int32x4_t s = vaddq_s32(sums, f.bias);
    const int64x2_t low = vmull_s32(vget_low_s32(s), vget_low_s32(f.multipliers));
    const int64x2_t high = vmull_high_s32(s, f.multipliers);
    return vshlq_s32(vaddhn_high_s64(vaddhn_s64(low, r.half), high, r.half), r.shift);
  }
  class Table {
   public:
    explicit Table(const std::uint8_t* bytes) {
      for (int k = 0; k < 4; ++k) table_[k] = vld1q_u8_x4(bytes + 64 * k);
    }
    uint8x16_t operator()(int32x4_t a, int32x4_t b, int32x4_t c, int32x4_t d) const {
      const int8x16_t t = vcombine_s8(vqmovn_s16(vcombine_s16(vqmovn_s32(a), vqmovn_s32(b))),
                                      vqmovn_s16(vcombine_s16(vqmovn_s32(c), vqmovn_s32(d))));
      // Indices out of range leave a byte as it is.
      uint8x16_t index = veorq_u8(vreinterpretq_u8_s8(t), vdupq_n_u8(128));
      uint8x16_t bytes = vqtbl4q_u8(table_[0], index);
      for (int k = 1; k < 4; ++k) {
        index = vsubq_u8(index, vdupq_n_u8(64));
        bytes = vqtbx4q_u8(bytes, table_[k], index);
      }
      return bytes;
    }

   private:
    uint8x16x4_t table_[4];
  };
  static void store_bytes(std::uint8_t* to, uint8x16_t bytes) { vst1q_u8(to, bytes); }

  static constexpr std::size_t kBlocks = 1;
  // The biases are -|p|^2.
  class Norms {
   public:
    void add(const Codes& p) {
      for (int i = 0; i < 4; ++i) sums_.v[i] = vdotq_s32(sums_.v[i], p.v[i], p.v[i]);
    }
    Sums biases() const {
      return {vnegq_s32(sums_.v[0]), vnegq_s32(sums_.v[1]), vnegq_s32(sums_.v[2]),
              vnegq_s32(sums_.v[3])};
    }

   private:
    Sums sums_ = {};
  };
  using Flags = uint32x4_t;
  static Flags at_least(const Sums& sums, std::int32_t threshold) {
    return vcgeq_s32(vmaxq_s32(vmaxq_s32(sums.v[0], sums.v[1]), vmaxq_s32(sums.v[2], sums.v[3])),
                     vdupq_n_s32(threshold));
  }
  static Flags either(Flags a, Flags b) { return vorrq_u32(a, b); }
  static bool any(Flags flags) { return vmaxvq_u32(flags) != 0; }
  static unsigned near_rows(const Sums& sums, std::int32_t threshold) {
    const int32x4_t least = vdupq_n_s32(threshold);
    return bits_of(vcgeq_s32(sums.v[0], least), vcgeq_s32(sums.v[1], least),
                   vcgeq_s32(sums.v[2], least), vcgeq_s32(sums.v[3], least));
  }

  static constexpr int kWordQueries = 2;
  static constexpr std::size_t kByteWords = 31;  // a byte counts 31 * 8 bits
  struct Words {
    uint64x2_t v[4];
  };
  struct Bytes {
    uint8x16_t v[4];
  };
  using Counts = Words;
  static Words load_words(const std::uint64_t* words) {
    return {vld1q_u64(words), vld1q_u64(words + 2), vld1q_u64(words + 4), vld1q_u64(words + 6)};
  }
  static void add_bits(Bytes& bytes, std::uint64_t query, const Words& row) {
    for (int i = 0; i < 4; ++i) {
      const uint64x2_t differ = veorq_u64(vdupq_n_u64(query), row.v[i]);
      bytes.v[i] = vaddq_u8(bytes.v[i], vcntq_u8(vreinterpretq_u8_u64(differ)));
    }
  }
  static void add_bytes(Counts& counts, const Bytes& bytes) {
    for (int i = 0; i < 4; ++i) {
      counts.v[i] = vpadalq_u32(counts.v[i], vpaddlq_u16(vpaddlq_u8(bytes.v[i])));
    }
  }
  static unsigned near_words(const Counts& counts, std::int32_t limit) {
    const int64x2_t most = vdupq_n_s64(limit);
    const auto near = [&](int i) {
      return vmovn_u64(vcleq_s64(vreinterpretq_s64_u64(counts.v[i]), most));
    };
    const uint32x4_t none = vdupq_n_u32(0);
    return bits_of(vcombine_u32(near(0), near(1)), vcombine_u32(near(2), near(3)), none, none);
  }
  static void store_counts(std::int64_t* to, const Counts& counts) {
    for (int i = 0; i < 4; ++i) vst1q_s64(to + 2 * i, vreinterpretq_s64_u64(counts.v[i]));
  }
};

}  // namespace

const Kernels neon = {.name = "neon",
                      .bit_sums = bit_sums<Neon>,
                      .bit_sum = bit_sum<Neon>,
                      .dense = dense<Neon>,
                      .activate16 = activate<Neon, std::int16_t>,
                      .activate32 = activate<Neon, std::int32_t>,
                      .code_biases = code_biases<Neon>,
                      .code_scan = code_scan<Neon>,
                      .hamming_scan = hamming_scan<Neon>};

}  // namespace protomark::kernels
