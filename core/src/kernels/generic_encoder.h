// The encoder's kernels, written once over a set S of vector operations. What S has to offer stands
// with the functions that use it. Everything here has internal linkage: see kernels.h.
#pragma once

#include "kernels/kernels.h"

namespace protomark::kernels {
namespace {

// The sums of all subsets of 4 inputs, for each 4 of 64 inputs.
//   S::Sums16             S::kSums16 sums of 16 bits: zero16(), add16(), load16(), store16(), and
//                         widen(), which loads weights; so many that a table fits the L1 cache
template <typename S>
void fill_table(const std::int8_t* weights, typename S::Sums16* table) {
  using Sums16 = typename S::Sums16;
  for (int group = 0; group < 16; ++group, weights += 4 * kOutputs) {
    const Sums16 a = S::widen(weights), b = S::widen(weights + kOutputs);
    const Sums16 c = S::widen(weights + 2 * kOutputs), d = S::widen(weights + 3 * kOutputs);
    const Sums16 low[4] = {S::zero16(), a, b, S::add16(a, b)};
    const Sums16 high[4] = {S::zero16(), c, d, S::add16(c, d)};
    for (const Sums16& h : high) {
      for (const Sums16& l : low) *table++ = S::add16(h, l);
    }
  }
}

template <typename S>
void bit_sums(const std::int8_t* weights, const std::uint64_t* words, std::size_t count,
              std::size_t n, std::int16_t* sums) {
  typename S::Sums16 table[256];
  for (std::size_t w = 0; w < count; ++w, words += n, weights += 64 * kOutputs) {
    for (std::size_t o = 0; o < kOutputs; o += S::kSums16) {
      fill_table<S>(weights + o, table);
      std::int16_t* sum = sums + o;
      for (std::size_t i = 0; i < n; ++i, sum += kOutputs) {
        typename S::Sums16 acc = w == 0 ? S::zero16() : S::load16(sum);
        for (int group = 0; group < 16; ++group) {
          acc = S::add16(acc, table[16 * group + (words[i] >> (4 * group) & 15)]);
        }
        S::store16(sum, acc);
      }
    }
  }
}

template <typename S>
void bit_sum(const std::int8_t* weights, const std::uint16_t* set, std::size_t count,
             std::int16_t* sums) {
  constexpr std::size_t kParts = kOutputs / S::kSums16;
  typename S::Sums16 acc[kParts];
  for (std::size_t p = 0; p < kParts; ++p) acc[p] = S::zero16();
  for (std::size_t i = 0; i < count; ++i) {
    const std::int8_t* row = weights + set[i] * kOutputs;
    for (std::size_t p = 0; p < kParts; ++p) {
      acc[p] = S::add16(acc[p], S::widen(row + p * S::kSums16));
    }
  }
  for (std::size_t p = 0; p < kParts; ++p) S::store16(sums + p * S::kSums16, acc[p]);
}

//   S::Inputs             S::kLanes, 1 or 4, times 4 inputs: inputs(x); dot_lane<L>(sums, inputs,
//                         weights) is dot with the L-th 4 of them
template <typename S, int Lane, int Batch, int Groups>
[[gnu::always_inline]] inline void dense_step(typename S::Sums (&acc)[Batch][Groups],
                                              const typename S::Inputs (&values)[Batch],
                                              const std::int8_t* weights, std::size_t inputs) {
  typename S::Codes w[Groups];
  for (int g = 0; g < Groups; ++g) w[g] = S::load_codes(weights + 16 * (g * inputs + 4 * Lane));
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < Groups; ++g) S::template dot_lane<Lane>(acc[i][g], values[i], w[g]);
  }
}

// `Batch` inputs share each load of the weights, `Groups` times 16 outputs each load of the inputs.
//   S::Sums, S::Codes     as in generic_search.h, for 16 outputs and their weights
//   S::dense_start(weights, inputs)  sums of no inputs at all, for 16 outputs
template <typename S, int Batch, int Groups>
void dense_tile(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                std::size_t stride, const typename S::Sums* start, std::int32_t* sums) {
  typename S::Sums acc[Batch][Groups];
  for (auto& row : acc) {
    for (int g = 0; g < Groups; ++g) row[g] = start[g];
  }
  for (std::size_t j = 0; j < inputs; j += 4 * S::kLanes) {
    typename S::Inputs values[Batch];
    for (int i = 0; i < Batch; ++i) values[i] = S::inputs(x + i * stride + j);
    dense_step<S, 0>(acc, values, weights + 16 * j, inputs);
    if constexpr (S::kLanes == 4) {
      dense_step<S, 1>(acc, values, weights + 16 * j, inputs);
      dense_step<S, 2>(acc, values, weights + 16 * j, inputs);
      dense_step<S, 3>(acc, values, weights + 16 * j, inputs);
    }
  }
  for (int i = 0; i < Batch; ++i) {
    for (int g = 0; g < Groups; ++g) S::store(sums + i * kOutputs + 16 * g, acc[i][g]);
  }
}

template <typename S, int Groups>
void dense_groups(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
                  std::size_t stride, std::size_t n, std::int32_t* sums) {
  typename S::Sums start[Groups];
  for (int g = 0; g < Groups; ++g) start[g] = S::dense_start(weights + 16 * g * inputs, inputs);
  std::size_t i = 0;
  for (; i + S::kDenseBatch <= n; i += S::kDenseBatch) {
    dense_tile<S, S::kDenseBatch, Groups>(weights, inputs, x + i * stride, stride, start,
                                          sums + i * kOutputs);
  }
  for (; i < n; ++i) {
    dense_tile<S, 1, Groups>(weights, inputs, x + i * stride, stride, start, sums + i * kOutputs);
  }
}

template <typename S>
void dense(const std::int8_t* weights, std::size_t inputs, const std::uint8_t* x,
           std::size_t stride, std::size_t n, std::size_t outputs, std::int32_t* sums) {
  std::size_t o = 0;
  for (; o + 16 * S::kDenseGroups <= outputs; o += 16 * S::kDenseGroups) {
    dense_groups<S, S::kDenseGroups>(weights + o * inputs, inputs, x, stride, n, sums + o);
  }
  if (o < outputs) dense_groups<S, 1>(weights + o * inputs, inputs, x, stride, n, sums + o);
}

// Only for shifts of 32 and more.
//   S::Ints               a register of S::kInts numbers of 32 bits: load_ints() from either kind
//   of
//                         sums
//   S::scaled(sums, factors(bias, multipliers), rounding(shift))  the numbers before they are
//                         clamped, of as many outputs
//   S::Table(bytes)       256 bytes: table(t, u, v, w) clamps numbers to int8 and looks them up
template <typename S, typename Sum>
void activate(const Activation& a, const Sum* sums, std::size_t n, std::uint8_t* next,
              std::size_t stride) {
  constexpr std::size_t kParts = kOutputs / S::kInts;
  const typename S::Table table(a.table);
  const typename S::Rounding rounding = S::rounding(a.shift);
  typename S::Factors factors[kParts];
  for (std::size_t p = 0; p < kParts; ++p) {
    factors[p] = S::factors(a.bias + p * S::kInts, a.multipliers + p * S::kInts);
  }
  for (std::size_t i = 0; i < n; ++i, sums += kOutputs, next += stride) {
    for (std::size_t p = 0; p < kParts; p += 4) {
      const auto part = [&](std::size_t q) {
        return S::scaled(S::load_ints(sums + (p + q) * S::kInts), factors[p + q], rounding);
      };
      S::store_bytes(next + p * S::kInts, table(part(0), part(1), part(2), part(3)));
    }
  }
}

}  // namespace
}  // namespace protomark::kernels
