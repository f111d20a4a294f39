// Whose the rows of packed prototypes are.
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/packed_numbers.h"
#include "protomark/search.h"
#include "search/top_k.h"

namespace protomark {

// The landmark of any row, unless only numbers of rows are known (RowLandmarks::rows_of).
class RowNumbers {
 public:
  explicit RowNumbers(const RowLandmarks& landmarks) : landmarks_(landmarks) {}

  // Offers the landmark of a row unless the row is padding. `ids`: of each landmark; nullptr: its
  // number. Throws FileError where an order is broken there.
  void offer(TopK& best, std::int32_t distance, std::size_t row, const std::int64_t* ids) const {
    std::size_t number = row;
    if (landmarks_.of_row != nullptr) {
      number = landmarks_.of_row[row];
    } else if (landmarks_.order != nullptr) {
      number = (*landmarks_.order)[row];
    }
    if (number >= landmarks_.end) return;
    const std::int64_t id = ids != nullptr ? ids[number] : static_cast<std::int64_t>(number);
    if (id < 0) return;
    if (landmarks_.of_row == nullptr && landmarks_.order == nullptr) {
      best.offer(distance, id);
    } else {
      best.offer_distinct(distance, id);
    }
  }

 private:
  RowLandmarks landmarks_;
};

}  // namespace protomark
