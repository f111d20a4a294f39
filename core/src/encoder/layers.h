// The layers of an encoder as the kernels take them: weights in blocks of 64 outputs, the last
// block padded with zeros.
#pragma once

#include <utility>

#include "kernels/kernels.h"
#include "protomark/encoder.h"

namespace protomark {

// Returns the least and the largest sum of an output's weights over any subset of its inputs.
std::pair<std::int64_t, std::int64_t> sum_range(const Layer& layer, std::size_t output);

// Turns sums into bytes by a table, in a last layer, too.
class PackedActivation {
 public:
  PackedActivation(const Layer& layer, bool last);

  std::size_t outputs() const { return bias_.size(); }
  kernels::Activation block(std::size_t first) const {
    return {&bias_[first], &multipliers_[first], table_.data(), shift_};
  }
  // Vector kernels do not take small shifts, which trained networks do not have.
  bool is_for_vectors() const { return shift_ >= 32; }

 private:
  std::vector<std::int32_t> bias_;
  std::vector<std::int32_t> multipliers_;
  std::array<std::uint8_t, 256> table_;
  int shift_;
};

// A first layer, whose inputs are bits. For many descriptors it tabulates the sums of all subsets
// of every 4 inputs per block of outputs, so that one load and one 16-bit addition serve 4 inputs
// ("four Russians"). For fewer it adds the weights of the bits that are set.
class BitLayer {
 public:
  BitLayer(const Layer& layer, bool last);

  std::size_t outputs() const { return activation_.outputs(); }
  // Computes the first `outputs` outputs of descriptors (n x bytes) as the first columns of `next`,
  // whose rows have room for whole blocks of outputs.
  void run(const kernels::Kernels& kernel, Descriptors descriptors, std::size_t outputs,
           MatrixView<std::uint8_t> next) const;

 private:
  class Input;

  std::size_t words_;                 // 64 bits each
  std::size_t span_;                  // words whose sums stay within 16 bits
  std::vector<std::int8_t> weights_;  // blocks x inputs x 64
  PackedActivation activation_;
};

// A later layer, whose inputs are bytes.
class DenseLayer {
 public:
  DenseLayer(const Layer& layer, bool last);

  std::size_t outputs() const { return activation_.outputs(); }
  // Computes the first `outputs` outputs of inputs (n x bytes), as BitLayer does.
  void run(const kernels::Kernels& kernel, MatrixView<const std::uint8_t> x, std::size_t outputs,
           MatrixView<std::uint8_t> next) const;

 private:
  std::size_t inputs_;
  std::vector<std::int8_t> weights_;
  PackedActivation activation_;
};

}  // namespace protomark
