// Writes codes as words of a codebook, and reads them back.
#pragma once

#include <algorithm>

#include "kernels/kernels.h"
#include "protomark/encoder.h"

namespace protomark {

// Returns the numbers of each word as kernels::Kernels::code_decode takes them, of codes of `dim`
// numbers.
inline std::vector<int8_t> decode_table(const Codebook& codebook, size_t dim) {
  const size_t width = codebook.width;
  std::vector<int8_t> table((dim + 3) / 4 * 4 * Codebook::kWords);
  for (size_t d = 0; d < dim; ++d) {
    for (size_t word = 0; word < Codebook::kWords; ++word) {
      table[d * Codebook::kWords + word] =
          codebook.words[(d / width * Codebook::kWords + word) * width + d % width];
    }
  }
  return table;
}

// Finds the words that are nearest to codes, ties to the smaller.
class NearestWords {
 public:
  NearestWords(const Codebook& codebook, size_t dim)
      : width_(codebook.width), words_(dim / width_ * kSubspace), keys_(words_.size() / 4) {
    for (size_t i = 0; i < keys_.size(); ++i) {
      std::copy_n(&codebook.words[i * width_], width_, &words_[4 * i]);
    }
    const size_t blocks = keys_.size() / kernels::kCodeRows;
    kernels::active().code_biases(words_.data(), blocks, 4, 4, keys_.data(), nullptr);
    for (size_t i = 0; i < keys_.size(); ++i) {
      keys_[i] = 256 * keys_[i] + 255 - static_cast<int32_t>(i % Codebook::kWords);
    }
  }

  size_t words() const { return words_.size() / kSubspace; }
  // Finds the words of n codes, at most 16: for each subspace, n words.
  void find(const int8_t* codes, size_t stride, size_t n, uint8_t* words) const {
    for (size_t w = 0; w < this->words(); ++w, words += n) {
      uint8_t numbers[4 * kernels::kCodeRows];
      std::fill_n(numbers, 4 * n, uint8_t{128});
      for (size_t i = 0; i < n; ++i) {
        for (size_t j = 0; j < width_; ++j) {
          numbers[4 * i + j] = static_cast<uint8_t>(codes[i * stride + w * width_ + j] + 128);
        }
      }
      kernels::active().nearest_words(&words_[w * kSubspace], &keys_[w * Codebook::kWords], numbers,
                                      n, words);
    }
  }

 private:
  static constexpr size_t kSubspace = 4 * Codebook::kWords;

  size_t width_;
  std::vector<int8_t> words_;  // of each subspace, zeros up to 4 numbers
  std::vector<int32_t> keys_;
};

}  // namespace protomark
