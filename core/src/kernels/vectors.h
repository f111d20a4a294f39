// Vectors of GCC and Clang, with the arithmetic of their elements. Linkage: see kernels.h.
#pragma once

#include <cstddef>
#include <cstdint>
#include <type_traits>

namespace protomark::kernels {
namespace {

template <typename T, size_t Bytes>
struct VectorOf {
  typedef T Type __attribute__((vector_size(Bytes)));
};
template <typename T, size_t Bytes>
using Vector = typename VectorOf<T, Bytes>::Type;

// Numbers or vectors at any address. GCC would split a memcpy of them.
template <typename V>
struct Unaligned {
  typedef V Type __attribute__((aligned(1), may_alias));
};
template <typename V>
V load(const void* p) {
  return *static_cast<const typename Unaligned<V>::Type*>(p);
}
template <typename V>
void store(void* p, const V& v) {
  *static_cast<typename Unaligned<V>::Type*>(p) = v;
}

// N vectors as one.
template <typename V, int N>
struct Pack {
  static constexpr size_t kLanes = N * sizeof(V) / sizeof(V{}[0]);
  V v[N];

  friend Pack operator+(const Pack& a, const Pack& b) {
    Pack sum;
    for (int i = 0; i < N; ++i) sum.v[i] = a.v[i] + b.v[i];
    return sum;
  }
  friend Pack operator>>(const Pack& a, int bits) {
    Pack result;
    for (int i = 0; i < N; ++i) result.v[i] = a.v[i] >> bits;
    return result;
  }
};

template <typename P>
P load_pack(const void* p) {
  P result;
  for (auto& v : result.v) {
    v = load<std::remove_reference_t<decltype(v)>>(p);
    p = static_cast<const char*>(p) + sizeof v;
  }
  return result;
}
template <typename P>
void store_pack(void* p, const P& pack) {
  for (const auto& v : pack.v) {
    store(p, v);
    p = static_cast<char*>(p) + sizeof v;
  }
}

// Multiplies bytes as 16-bit numbers, for sets without an instruction for bytes or whose one
// saturates: the 4 dimensions of a row, a 32-bit lane, become numbers (0, 2) and (1, 3), and
// Set::multiply_pairs(a, b) sums up the two products of each lane.
template <typename Set, size_t Bytes>
struct ByPairs {
  static constexpr int kVectors = 64 / Bytes;
  using Shorts = Vector<int16_t, Bytes>;
  using Ints = Vector<int32_t, Bytes>;
  using Sums = Pack<Ints, kVectors>;

  struct Codes {
    Shorts even[kVectors], odd[kVectors];
  };
  static Codes load_codes(const int8_t* p) {
    Codes codes;
    for (int i = 0; i < kVectors; ++i) {
      const auto both = load<Shorts>(p + Bytes * i);
      codes.even[i] = both << 8 >> 8;
      codes.odd[i] = both >> 8;
    }
    return codes;
  }
  struct Query {
    Shorts even, odd;
  };
  static void dot(Sums& sums, const Query& q, const Codes& codes) {
    for (int i = 0; i < kVectors; ++i) {
      sums.v[i] +=
          Set::multiply_pairs(codes.even[i], q.even) + Set::multiply_pairs(codes.odd[i], q.odd);
    }
  }
  // Four bytes for all rows.
  static Query query(const uint8_t* codes) {
    const auto four = (Vector<uint16_t, Bytes>)(Ints{} + load<int32_t>(codes));
    return {(Shorts)(four & 0xff), (Shorts)(four >> 8)};
  }

  // The biases are -|p|^2 - 256 sum(p), as queries come as q + 128.
  class Norms {
   public:
    void add(const Codes& p) {
      for (int i = 0; i < kVectors; ++i) {
        squares_.v[i] +=
            Set::multiply_pairs(p.even[i], p.even[i]) + Set::multiply_pairs(p.odd[i], p.odd[i]);
        sums_.v[i] += Set::multiply_pairs(p.even[i] + p.odd[i], Shorts{} + 1);
      }
    }
    Sums biases() const {
      Sums biases;
      for (int i = 0; i < kVectors; ++i) biases.v[i] = -squares_.v[i] - (sums_.v[i] << 8);
      return biases;
    }

   private:
    Sums squares_ = {}, sums_ = {};
  };
};

}  // namespace
}  // namespace protomark::kernels
