// The layers of an encoder as the kernels take them: weights in blocks of 64 outputs, the last
// block padded with zeros.
#pragma once

#include <bit>

#include "kernels/kernels.h"
#include "protomark/encoder.h"

namespace protomark {

using kernels::kOutputs;

// From this number of descriptors on a table pays.
inline constexpr size_t kMinTabulated = 20;
// Sums of 256 weights, -128 to 127, stay within 16 bits.
inline constexpr size_t kSafeWords = 256 / 64;
// Inputs of a dense layer that go through it together.
inline constexpr size_t kDenseBatch = 64;

constexpr size_t round_up(size_t n, size_t to) { return (n + to - 1) / to * to; }

template <typename T>
std::vector<T> padded(const std::vector<T>& values) {
  std::vector<T> result = values;
  result.resize(round_up(values.size(), kOutputs));
  return result;
}

// Returns the least and the largest sum of an output's weights over any subset of its inputs.
inline std::pair<int64_t, int64_t> sum_range(const Layer& layer, size_t output) {
  int64_t low = 0, high = 0;
  for (size_t i = 0; i < layer.inputs; ++i) {
    const int8_t weight = layer.weights[output * layer.inputs + i];
    (weight < 0 ? low : high) += weight;
  }
  return {low, high};
}

inline bool fits_16_bits(const Layer& layer) {
  for (size_t o = 0; o < layer.outputs; ++o) {
    const auto [low, high] = sum_range(layer, o);
    if (low < INT16_MIN || high > INT16_MAX) return false;
  }
  return true;
}

// Turns sums into bytes by a table, in a last layer, too.
class PackedActivation {
 public:
  PackedActivation(const Layer& layer, bool last)
      : bias_(padded(layer.bias)),
        multipliers_(padded(layer.multipliers)),
        table_(layer.table),
        shift_(layer.shift) {
    if (!last) return;
    for (size_t i = 0; i < table_.size(); ++i) {
      table_[i] = static_cast<uint8_t>(std::max(static_cast<int>(i) - 128, -127));
    }
  }

  size_t outputs() const { return bias_.size(); }
  kernels::Activation block(size_t first) const {
    return {&bias_[first], &multipliers_[first], table_.data(), shift_};
  }
  // Vector kernels do not take small shifts, which trained networks do not have.
  bool is_for_vectors() const { return shift_ >= 32; }

 private:
  std::vector<int32_t> bias_;
  std::vector<int32_t> multipliers_;
  std::array<uint8_t, 256> table_;
  int shift_;
};

// A first layer whose inputs are bits. For many descriptors it tabulates the sums of all subsets
// of every 4 inputs per block of outputs, so that one load and one 16-bit addition serve 4 inputs
// ("four Russians"). For fewer it adds the weights of the bits that are set.
class BitLayer {
 public:
  BitLayer(const Layer& layer, bool last)
      : words_((layer.inputs + 63) / 64),
        span_(fits_16_bits(layer) ? words_ : kSafeWords),
        weights_(words_ * 64 * round_up(layer.outputs, kOutputs)),
        activation_(layer, last) {
    for (size_t o = 0; o < layer.outputs; ++o) {
      int8_t* block = &weights_[o / kOutputs * kOutputs * words_ * 64];
      for (size_t i = 0; i < layer.inputs; ++i) {
        block[i * kOutputs + o % kOutputs] = layer.weights[o * layer.inputs + i];
      }
    }
  }

  size_t outputs() const { return activation_.outputs(); }
  // Computes the first `outputs` outputs of descriptors (n x bytes) as the first columns of `next`,
  // whose rows have room for whole blocks of outputs.
  void run(const kernels::Kernels& kernel, Descriptors descriptors, size_t outputs,
           MatrixView<uint8_t> next) const {
    const Input input(*this, descriptors);
    const size_t n = descriptors.rows;
    const kernels::Kernels& activate = activation_.is_for_vectors() ? kernel : kernels::portable;
    const auto sums = std::make_unique_for_overwrite<int16_t[]>(n * kOutputs);
    std::vector<int32_t> wide(span_ < words_ ? n * kOutputs : 0);
    for (size_t o = 0; o < outputs; o += kOutputs) {
      const int8_t* weights = &weights_[o * words_ * 64];
      if (wide.empty()) {
        input.sums(kernel, weights, 0, sums.get());
        activate.activate16(activation_.block(o), sums.get(), n, next.data + o, next.columns);
        continue;
      }
      std::fill(wide.begin(), wide.end(), 0);
      for (size_t first = 0; first < words_; first += span_) {
        input.sums(kernel, weights, first, sums.get());
        for (size_t i = 0; i < wide.size(); ++i) wide[i] += sums[i];
      }
      activate.activate32(activation_.block(o), wide.data(), n, next.data + o, next.columns);
    }
  }

 private:
  // Descriptors as bit_sums or bit_sum take them.
  class Input {
   public:
    Input(const BitLayer& layer, Descriptors descriptors)
        : layer_(layer), n_(descriptors.rows), words_(n_ * layer.words_) {
      for (size_t i = 0; i < n_; ++i) {
        for (size_t b = 0; b < descriptors.columns; ++b) {
          words_[b / 8 * n_ + i] |= uint64_t{descriptors.row(i)[b]} << (b % 8 * 8);
        }
      }
      if (n_ < kMinTabulated) list_set_bits();
    }

    // Sums up the words of a span from `first` on, with the weights of a block.
    void sums(const kernels::Kernels& kernel, const int8_t* weights, size_t first,
              int16_t* sums) const {
      weights += first * 64 * kOutputs;
      if (set_.empty()) {
        const size_t count = std::min(layer_.span_, layer_.words_ - first);
        kernel.bit_sums(weights, &words_[first * n_], count, n_, sums);
        return;
      }
      for (size_t i = 0; i < n_; ++i) {
        const size_t at = i * layer_.words_ + first;
        kernel.bit_sum(weights, &set_[at * 64], counts_[at], sums + i * kOutputs);
      }
    }

   private:
    // Lists the set bits of each span, counted from its first bit, at the index of its first word.
    void list_set_bits() {
      set_.resize(words_.size() * 64);
      counts_.resize(words_.size());
      for (size_t i = 0; i < n_; ++i) {
        for (size_t w = 0; w < layer_.words_; ++w) {
          const size_t first = w / layer_.span_ * layer_.span_;
          size_t& count = counts_[i * layer_.words_ + first];
          uint16_t* set = &set_[(i * layer_.words_ + first) * 64];
          for (uint64_t word = words_[w * n_ + i]; word != 0; word &= word - 1) {
            set[count++] = static_cast<uint16_t>((w - first) * 64 +
                                                 static_cast<size_t>(std::countr_zero(word)));
          }
        }
      }
    }

    const BitLayer& layer_;
    size_t n_;
    std::vector<uint64_t> words_;  // words x n
    std::vector<uint16_t> set_;    // n x bits
    std::vector<size_t> counts_;   // n x words
  };

  size_t words_;                 // 64 bits each
  size_t span_;                  // words whose sums stay within 16 bits
  std::vector<int8_t> weights_;  // blocks x inputs x 64
  PackedActivation activation_;
};

// A layer whose inputs are bytes.
class DenseLayer {
 public:
  DenseLayer(const Layer& layer, bool last)
      : inputs_(round_up(layer.inputs, kOutputs)),
        weights_(inputs_ * round_up(layer.outputs, kOutputs)),
        activation_(layer, last) {
    for (size_t o = 0; o < layer.outputs; ++o) {
      int8_t* group = &weights_[o / 16 * 16 * inputs_];
      for (size_t i = 0; i < layer.inputs; ++i) {
        group[i / 4 * 4 * 16 + o % 16 * 4 + i % 4] = layer.weights[o * layer.inputs + i];
      }
    }
  }

  size_t inputs() const { return inputs_; }  // of which the last ones may have no weights
  size_t outputs() const { return activation_.outputs(); }
  // Computes the first `outputs` outputs of inputs (n x bytes), as BitLayer does.
  void run(const kernels::Kernels& kernel, MatrixView<const uint8_t> x, size_t outputs,
           MatrixView<uint8_t> next) const {
    const kernels::Kernels& activate = activation_.is_for_vectors() ? kernel : kernels::portable;
    std::vector<int32_t> sums(std::min(x.rows, kDenseBatch) * kOutputs);
    for (size_t i = 0; i < x.rows; i += kDenseBatch) {
      const size_t batch = std::min(kDenseBatch, x.rows - i);
      for (size_t o = 0; o < outputs; o += kOutputs) {
        kernel.dense(&weights_[o * inputs_], inputs_, x.row(i), x.columns, batch,
                     round_up(std::min(outputs - o, kOutputs), 16), sums.data());
        activate.activate32(activation_.block(o), sums.data(), batch, next.row(i) + o,
                            next.columns);
      }
    }
  }

 private:
  size_t inputs_;
  std::vector<int8_t> weights_;
  PackedActivation activation_;
};

}  // namespace protomark
