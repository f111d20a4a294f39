// Writes codes as words of a codebook, and reads them back.
#pragma once

#include <algorithm>
#include <array>
#include <climits>

#include "base/quantize.h"
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

// Finds the words that are nearest to a code, ties to the smaller.
class NearestWords {
 public:
  NearestWords(const Codebook& codebook, size_t dim)
      : width_(codebook.width), words_(dim / width_ * Codebook::kWords) {
    for (size_t i = 0; i < words_.size(); ++i) {
      std::copy_n(&codebook.words[i * width_], width_, words_[i].numbers.data());
      words_[i].index = static_cast<uint8_t>(i % Codebook::kWords);
    }
    for (auto first = words_.begin(); first != words_.end(); first += Codebook::kWords) {
      std::ranges::sort(first, first + Codebook::kWords, {}, first_number);
      for (int number = -128; number < 128; ++number) {
        const auto at =
            std::ranges::lower_bound(first, first + Codebook::kWords, number, {}, first_number);
        starts_.push_back(static_cast<uint16_t>(at - first));
      }
    }
  }

  // Writes the word of each subspace, `stride` bytes apart.
  void find(const int8_t* code, uint8_t* words, size_t stride) const {
    for (size_t first = 0; first < words_.size(); first += Codebook::kWords, code += width_) {
      Numbers numbers{};
      std::copy_n(code, width_, numbers.data());
      *words =
          find(&words_[first], starts_[first + static_cast<size_t>(numbers[0] + 128)], numbers);
      words += stride;
    }
  }

 private:
  using Numbers = std::array<int8_t, 4>;  // zeros follow the last one
  struct Word {
    Numbers numbers{};
    uint8_t index = 0;
  };
  static int first_number(const Word& word) { return word.numbers[0]; }

  // Goes through the words by their first number, up and down from `start`, as far as one could be
  // nearer.
  static uint8_t find(const Word* words, size_t start, const Numbers& numbers) {
    int best = INT_MAX;
    uint8_t index = 0;
    const auto offer = [&](const Word& word) {
      const int apart = word.numbers[0] - numbers[0];
      if (apart * apart > best) return false;
      const int distance = squared_distance(word.numbers.data(), numbers.data(), 4);
      if (distance < best || (distance == best && word.index < index)) {
        best = distance;
        index = word.index;
      }
      return true;
    };
    for (size_t i = start; i < Codebook::kWords && offer(words[i]); ++i) continue;
    for (size_t i = start; i > 0 && offer(words[i - 1]); --i) continue;
    return index;
  }

  size_t width_;
  std::vector<Word> words_;       // of each subspace, by their first number
  std::vector<uint16_t> starts_;  // the first word whose first number is at least -128, -127, ...
};

}  // namespace protomark
