// How well the cells of a sealed map serve it.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <vector>

#include "map/place_writer.h"
#include "map/seal_rows.h"
#include "search/recall.h"

namespace protomark {

// The test queries of measure_recall: rows of test_rows, as landmarks come by id.
class TestQueries {
 public:
  explicit TestQueries(const SealedRows& rows)
      : rows_(&rows),
        tests_(test_rows(rows.size())),
        by_row_(tests_.size()),
        codes_(tests_.size() * rows.dim()),
        own_(tests_.size()) {
    std::iota(by_row_.begin(), by_row_.end(), std::size_t{0});
    std::sort(by_row_.begin(), by_row_.end(),
              [&](std::size_t a, std::size_t b) { return tests_[a] < tests_[b]; });
  }

  void add(std::uint32_t landmark) {
    const std::size_t end = row_ + rows_->rows_of(landmark);
    for (; next_ < by_row_.size() && tests_[by_row_[next_]] < end; ++next_) {
      const std::size_t i = by_row_[next_];
      rows_->code(rows_->sorted_rows(landmark)[tests_[i] - row_], &codes_[i * rows_->dim()]);
      own_[i] = rows_->store().ids()[landmark];
    }
    row_ = end;
  }

  Codes codes() const { return {codes_.data(), tests_.size(), rows_->dim()}; }
  // The id of the landmark of each.
  const std::vector<std::int64_t>& own() const { return own_; }

 private:
  const SealedRows* rows_;
  std::vector<std::size_t> tests_, by_row_;
  std::vector<std::int8_t> codes_;
  std::vector<std::int64_t> own_;
  std::size_t row_ = 0, next_ = 0;
};

RecallTable sealed_ranks(const SealedRows& rows, const BlockPacker& packer,
                         const TestQueries& tests);

}  // namespace protomark
