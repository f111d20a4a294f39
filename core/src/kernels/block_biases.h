// The biases of a block of rows, found where they are not known (PackedCodes::biases). Of internal
// linkage: each set of kernels is compiled with flags of its own.
#pragma once

#include "kernels.h"

namespace protomark::kernels {
namespace {

class BlockBiases {
 public:
  // `find` is code_biases of the same set.
  BlockBiases(const PackedCodes& rows, decltype(Kernels::code_biases) find)
      : rows_(rows), find_(find) {}

  // Of the 16 rows from `row` on, until the next call.
  const std::int32_t* operator()(std::size_t row) {
    if (rows_.biases != nullptr) return rows_.biases + row;
    find_(rows_.codes + row * rows_.dim, 1, rows_.dim, rows_.dim, own_, nullptr);
    return own_;
  }

 private:
  const PackedCodes& rows_;
  decltype(Kernels::code_biases) find_;
  std::int32_t own_[kCodeRows];
};

}  // namespace
}  // namespace protomark::kernels
