// The encoder's kernels over a set S of vector operations; comments with the functions say what S
// needs. Everything has internal linkage: see kernels.h.
#pragma once

#include "kernels/kernels.h"
#include "kernels/vectors.h"

namespace protomark::kernels {
namespace {

// Tabulates the sums of all subsets of 4 inputs, for each 4 of 64 inputs.
//   S::Sums16             16-bit sums of as many outputs as leave a table in the L1 cache: widen()
//                         loads weights
template <typename S>
void fill_table(const int8_t* weights, typename S::Sums16* table) {
  using Sums16 = typename S::Sums16;
  for (int group = 0; group < 16; ++group, weights += 4 * kOutputs) {
    const auto a = S::widen(weights), b = S::widen(weights + kOutputs);
    const auto c = S::widen(weights + 2 * kOutputs), d = S::widen(weights + 3 * kOutputs);
    const Sums16 low[4] = {{}, a, b, a + b}, high[4] = {{}, c, d, c + d};
    for (const Sums16& h : high) {
      for (const Sums16& l : low) *table++ = h + l;
    }
  }
}

template <typename S>
void bit_sums(const int8_t* weights, const uint64_t* words, size_t count, size_t n, int16_t* sums) {
  using Sums16 = typename S::Sums16;
  Sums16 table[256];
  for (size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (size_t o = 0; o < kOutputs; o += Sums16::kLanes) {
      fill_table<S>(weights + o, table);
      int16_t* sum = sums + o;
      for (size_t i = 0; i < n; ++i, sum += kOutputs) {
        Sums16 acc = w == 0 ? Sums16{} : load_pack<Sums16>(sum);
        for (int group = 0; group < 16; ++group) {
          acc = acc + table[16 * group + (words[i] >> (4 * group) & 15)];
        }
        store_pack(sum, acc);
      }
    }
  }
}

template <typename S>
void bit_sum(const int8_t* weights, const uint16_t* set, size_t count, int16_t* sums) {
  using Sums16 = typename S::Sums16;
  constexpr size_t kParts = kOutputs / Sums16::kLanes;
  Sums16 acc[kParts];
#pragma GCC unroll 4
  for (size_t p = 0; p < kParts; ++p) acc[p] = {};
  for (size_t i = 0; i < count; ++i) {
    const int8_t* row = weights + set[i] * kOutputs;
#pragma GCC unroll 4
    for (size_t p = 0; p < kParts; ++p) {
      acc[p] = acc[p] + S::widen(row + p * Sums16::kLanes);
    }
  }
#pragma GCC unroll 4
  for (size_t p = 0; p < kParts; ++p) store_pack(sums + p * Sums16::kLanes, acc[p]);
}

// `Batch` inputs share each load of the weights, `Groups` times 16 outputs each load of the inputs.
//   S::Sums, S::Codes, S::dot, S::query  as in generic_search.h, for 16 outputs and their weights
template <typename S, int Batch, int Groups>
void dense_tile(const int8_t* weights, size_t inputs, const uint8_t* x, size_t stride,
                const typename S::Sums* start, int32_t* sums) {
  typename S::Sums acc[Batch][Groups];
  for (auto& row : acc) {
    for (int g = 0; g < Groups; ++g) row[g] = start[g];
  }
  for (size_t j = 0; j < inputs; j += 4) {
    typename S::Codes w[Groups];
    for (int g = 0; g < Groups; ++g) w[g] = S::load_codes(weights + 16 * (g * inputs + j));
    for (int i = 0; i < Batch; ++i) {
      const auto four = S::query(x + i * stride + j);
      for (int g = 0; g < Groups; ++g) S::dot(acc[i][g], four, w[g]);
    }
  }
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < Groups; ++g) store_pack(sums + i * kOutputs + 16 * g, acc[i][g]);
  }
}

//   S::dense_start(weights, inputs)  optional: what sums of 16 outputs start from
template <typename S, int Groups>
void dense_groups(const int8_t* weights, size_t inputs, const uint8_t* x, size_t stride, size_t n,
                  int32_t* sums) {
  typename S::Sums start[Groups] = {};
  if constexpr (requires { S::dense_start(weights, inputs); }) {
    for (int g = 0; g < Groups; ++g) start[g] = S::dense_start(weights + 16 * g * inputs, inputs);
  }
  size_t i = 0;
  for (; i + S::kDenseBatch <= n; i += S::kDenseBatch) {
    dense_tile<S, S::kDenseBatch, Groups>(weights, inputs, x + i * stride, stride, start,
                                          sums + i * kOutputs);
  }
  for (; i < n; ++i) {
    dense_tile<S, 1, Groups>(weights, inputs, x + i * stride, stride, start, sums + i * kOutputs);
  }
}

template <typename S>
void dense(const int8_t* weights, size_t inputs, const uint8_t* x, size_t stride, size_t n,
           size_t outputs, int32_t* sums) {
  size_t o = 0;
  for (; o + 16 * S::kDenseGroups <= outputs; o += 16 * S::kDenseGroups) {
    dense_groups<S, S::kDenseGroups>(weights + o * inputs, inputs, x, stride, n, sums + o);
  }
  if (o < outputs) dense_groups<S, 1>(weights + o * inputs, inputs, x, stride, n, sums + o);
}

// Only for shifts of 32 and more.
//   S::Ints               a vector of 32-bit numbers: load_ints() from either kind of sums
//   S::scaled(sums, bias, multipliers, shift)  the numbers before they are clamped
//   S::Table(bytes)       256 bytes: table(t, u, v, w) clamps numbers to int8 and looks them up
template <typename S, typename Sum>
void activate(const Activation& a, const Sum* sums, size_t n, uint8_t* next, size_t stride) {
  using Ints = typename S::Ints;
  constexpr size_t kLanes = sizeof(Ints) / 4;
  const typename S::Table table(a.table);
  const int shift = a.shift;
  for (size_t o = 0; o < kOutputs; o += 4 * kLanes) {
    Ints bias[4], multipliers[4];
    for (size_t q = 0; q < 4; ++q) {
      bias[q] = load<Ints>(a.bias + o + q * kLanes);
      multipliers[q] = load<Ints>(a.multipliers + o + q * kLanes);
    }
    for (size_t i = 0; i < n; ++i) {
      const auto part = [&](size_t q) {
        const Sum* from = sums + i * kOutputs + o + q * kLanes;
        return S::scaled(S::load_ints(from), bias[q], multipliers[q], shift);
      };
      store(next + i * stride + o, table(part(0), part(1), part(2), part(3)));
    }
  }
}

// Returns S::activate where S has its own.
template <typename S, typename Sum>
constexpr auto activation_of() {
  if constexpr (requires { &S::template activate<Sum>; })
    return &S::template activate<Sum>;
  else
    return &activate<S, Sum>;
}

}  // namespace
}  // namespace protomark::kernels
