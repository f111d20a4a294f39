// NEON with dot products (ARMv8.2 and later): phones since 2018, Apple silicon, Graviton 2.
#include <arm_neon.h>

#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

// Sets bit r of the result where lane r is set, of 16 lanes of 32 bits or 8 of 64 bits.
unsigned bits_of(uint32x4_t a, uint32x4_t b, uint32x4_t c, uint32x4_t d) {
  const uint8x16_t lanes = vcombine_u8(vmovn_u16(vcombine_u16(vmovn_u32(a), vmovn_u32(b))),
                                       vmovn_u16(vcombine_u16(vmovn_u32(c), vmovn_u32(d))));
  const uint8x16_t weights = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
  const uint8x16_t bits = vandq_u8(lanes, weights);
  return vaddv_u8(vget_low_u8(bits)) | static_cast<unsigned>(vaddv_u8(vget_high_u8(bits))) << 8;
}

struct Neon {
  using Sums16 = Pack<int16x8_t, 4>;
  static Sums16 widen(const int8_t* w) {
    return {vmovl_s8(vld1_s8(w)), vmovl_s8(vld1_s8(w + 8)), vmovl_s8(vld1_s8(w + 16)),
            vmovl_s8(vld1_s8(w + 24))};
  }

  using Sums = Pack<int32x4_t, 4>;
  using Codes = Pack<int8x16_t, 4>;
  static Codes load_codes(const int8_t* codes) { return load_pack<Codes>(codes); }
  static void dot(Sums& sums, int8x16_t q, const Codes& codes) {
    for (int i = 0; i < 4; ++i) sums.v[i] = vdotq_s32(sums.v[i], codes.v[i], q);
  }
  // Both factors of vdot are signed, so queries lose the 128 that was added.
  using Step = int8_t[4];
  static void convert(const uint8_t* codes, size_t n, Step* steps) {
    for (size_t i = 0; i < 4 * n; ++i) {
      steps[i / 4][i % 4] = static_cast<int8_t>(codes[i] - 128);
    }
  }
  static int8x16_t query(const int8_t* codes) {
    return vreinterpretq_s8_s32(vdupq_n_s32(load<int32_t>(codes)));
  }
  static int8x16_t query(const uint8_t* codes) {
    const uint32x4_t four = vdupq_n_u32(load<uint32_t>(codes));
    return vreinterpretq_s8_u32(veorq_u32(four, vdupq_n_u32(0x80808080)));
  }
  static constexpr int kDenseBatch = 4;
  static constexpr int kDenseGroups = 1;
  // What the inputs lose with the 128.
  static Sums dense_start(const int8_t* weights, size_t inputs) {
    Sums sums = {};
    for (size_t j = 0; j < inputs; j += 4) {
      dot(sums, vdupq_n_s8(1), load_codes(weights + 16 * j));
    }
    for (int32x4_t& part : sums.v) part = vshlq_n_s32(part, 7);
    return sums;
  }

  using Ints = int32x4_t;
  static Ints load_ints(const int32_t* sums) { return vld1q_s32(sums); }
  static Ints load_ints(const int16_t* sums) { return vmovl_s16(vld1_s16(sums)); }
  // The upper halves of 64-bit products.
  static Ints scaled(Ints sums, Ints bias, Ints multipliers, int shift) {
    const int32x4_t s = vaddq_s32(sums, bias);
    const int64x2_t half = vdupq_n_s64(int64_t{1} << (shift - 1));
    const int64x2_t low = vmull_s32(vget_low_s32(s), vget_low_s32(multipliers));
    const int64x2_t high = vmull_high_s32(s, multipliers);
    const int32x4_t upper = vaddhn_high_s64(vaddhn_s64(low, half), high, half);
    return vshlq_s32(upper, vdupq_n_s32(32 - shift));
  }
  class Table {
   public:
    explicit Table(const uint8_t* bytes) {
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

  static constexpr size_t kBlocks = 1;
  // The biases are -|p|^2.
  class Norms {
   public:
    void add(const Codes& p) {
      for (int i = 0; i < 4; ++i) squares_.v[i] = vdotq_s32(squares_.v[i], p.v[i], p.v[i]);
    }
    Sums biases() const { return {-squares_.v[0], -squares_.v[1], -squares_.v[2], -squares_.v[3]}; }

   private:
    Sums squares_ = {};
  };
  using Flags = uint32x4_t;
  static Flags above(const Sums& sums, int32_t threshold) {
    return vcgtq_s32(vmaxq_s32(vmaxq_s32(sums.v[0], sums.v[1]), vmaxq_s32(sums.v[2], sums.v[3])),
                     vdupq_n_s32(threshold));
  }
  static bool any(Flags flags) { return vmaxvq_u32(flags) != 0; }
  static unsigned near_rows(const Sums& sums, int32_t threshold) {
    const int32x4_t least = vdupq_n_s32(threshold);
    return bits_of(vcgtq_s32(sums.v[0], least), vcgtq_s32(sums.v[1], least),
                   vcgtq_s32(sums.v[2], least), vcgtq_s32(sums.v[3], least));
  }

  static constexpr int kWordQueries = 2;
  using Words = Pack<uint64x2_t, 4>;
  using BitCounts = Pack<uint8x16_t, 4>;
  static constexpr size_t kByteWords = 31;  // a byte counts 31 * 8 bits
  static void add_bits(BitCounts& bytes, uint64_t query, const Words& row) {
    for (int i = 0; i < 4; ++i) {
      const uint64x2_t differ = veorq_u64(vdupq_n_u64(query), row.v[i]);
      bytes.v[i] = vaddq_u8(bytes.v[i], vcntq_u8(vreinterpretq_u8_u64(differ)));
    }
  }
  static void add_counts(Words& counts, const BitCounts& bytes) {
    for (int i = 0; i < 4; ++i) {
      counts.v[i] = vpadalq_u32(counts.v[i], vpaddlq_u16(vpaddlq_u8(bytes.v[i])));
    }
  }
  static unsigned near_words(const Words& counts, int32_t limit) {
    const int64x2_t limits = vdupq_n_s64(limit);
    const auto near = [&](int i) {
      return vmovn_u64(vcleq_s64(vreinterpretq_s64_u64(counts.v[i]), limits));
    };
    const uint32x4_t none = vdupq_n_u32(0);
    return bits_of(vcombine_u32(near(0), near(1)), vcombine_u32(near(2), near(3)), none, none);
  }
};

}  // namespace

constinit const Kernels neon = kernels_of<Neon>("neon");

}  // namespace protomark::kernels
