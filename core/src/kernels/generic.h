// All kernels over a set S of vector operations.
#pragma once

#include "kernels/generic_encoder.h"
#include "kernels/generic_search.h"

namespace protomark::kernels {
namespace {

// A set may have its own.
template <typename S, typename Sum>
constexpr auto activation_of() {
  if constexpr (requires { &S::template activate<Sum>; })
    return &S::template activate<Sum>;
  else
    return &activate<S, Sum>;
}

template <typename S>
constexpr Kernels kernels_of(const char* name) {
  return {.name = name,
          .bit_sums = bit_sums<S>,
          .bit_sum = bit_sum<S>,
          .dense = dense<S>,
          .activate16 = activation_of<S, std::int16_t>(),
          .activate32 = activation_of<S, std::int32_t>(),
          .code_biases = code_biases<S>,
          .code_unpack4 = code_unpack4<S>,
          .code_scan = code_scan<S>,
          .hamming_scan = hamming_scan<S>};
}

}  // namespace
}  // namespace protomark::kernels
