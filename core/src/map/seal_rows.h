// The rows that a map is sealed with.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "map/prototype_store.h"
#include "search/coarse_quantizer.h"

namespace protomark {

// Rounded prototypes. Where none has to be joined these are the map's, which must not change
// meanwhile, with the numbers that they have there.
class SealedRows {
 public:
  // At most `prototypes` a landmark over the whole map, and 255 for any one.
  SealedRows(const PrototypeStore& store, std::optional<double> prototypes);

  const PrototypeStore& store() const { return *store_; }
  std::size_t dim() const { return store_->dim(); }
  std::size_t size() const { return joined_ ? joined_->landmarks.size() : store_->rows(); }
  // Whether any landmark has more than one row.
  bool several() const { return size() != store_->landmarks(); }

  // Of a landmark of the map: how many rows it has, and which, by look.
  std::size_t rows_of(std::uint32_t landmark) const;
  std::vector<std::uint32_t> sorted_rows(std::uint32_t landmark) const;
  // Calls take(row) for each of these.
  template <typename Take>
  void each_sorted_row(std::uint32_t landmark, const Take& take) const {
    if (store_->look_bits() == 0) {
      take(store_->first_row(landmark));
    } else {
      for (const std::uint32_t row : sorted_rows(landmark)) take(row);
    }
  }
  std::uint32_t landmark_of(std::uint32_t row) const;
  // Cell 0 has all rows where there is no index.
  std::size_t rows_in(std::uint32_t cell) const;
  std::uint32_t cell_of(std::uint32_t row) const;
  // Hands over the rows of a cell by id of the landmark and then look, a piece at a time.
  void visit_sorted_rows(std::uint32_t cell, const PrototypeStore::Visit& visit) const;
  // Calls take(row) for all rows, in no order.
  template <typename Take>
  void each_row(const Take& take) const {
    const std::size_t end = joined_ ? size() : store_->places();
    for (std::uint32_t row = 0; row < end; ++row) {
      if (joined_ || store_->is_row(row)) take(row);
    }
  }
  void code(std::uint32_t row, std::int8_t* to) const;

 private:
  // Joined rows, by id and then look.
  struct Joined {
    std::vector<std::int8_t> codes;
    std::vector<std::uint32_t> landmarks;   // of each row
    std::vector<std::uint32_t> first_rows;  // of each landmark
    std::vector<std::uint32_t> cells;       // of each row
    std::vector<std::uint32_t> by_cell;     // rows
    std::vector<std::uint32_t> cell_ends;   // there
  };
  void join(double most);

  const PrototypeStore* store_;
  std::optional<Joined> joined_;
};

}  // namespace protomark
