// The rows that a map is sealed with.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "prototype_store.h"

namespace protomark {

// Rounded prototypes in the order of landmarks, those by id, and within a landmark by look. Where
// none had to be joined they are read from the map, which must not change meanwhile.
class SealedRows {
 public:
  // At most `prototypes` a landmark over the whole map, and 255 for any one.
  SealedRows(const PrototypeStore& store, std::optional<double> prototypes);

  std::size_t dim() const { return store_->dim(); }
  // Numbers of the landmarks in the map, by id.
  const std::vector<std::uint32_t>& landmarks() const { return landmarks_; }
  std::size_t size() const { return first_rows_.empty() ? landmarks_.size() : first_rows_.back(); }
  // Whether any landmark has more than one row.
  bool several() const { return !first_rows_.empty(); }
  // The first row of landmarks()[i], where those of the one before end.
  std::size_t first_row(std::size_t i) const { return several() ? first_rows_[i] : i; }
  // The landmark of a row, as a place in landmarks().
  std::size_t landmark_of(std::size_t row) const;
  // The cell of a row, 0 where there is no index.
  std::uint32_t cell_of(std::size_t row) const {
    return joined() ? cells_[row] : store_->blocks().cell_of(number(row));
  }
  void code(std::size_t row, std::int8_t* to) const;

 private:
  bool joined() const { return !codes_.empty(); }
  std::uint32_t number(std::size_t row) const {
    return several() ? numbers_[row] : store_->first_row(landmarks_[row]);
  }
  void take();
  void join(double most);

  const PrototypeStore* store_;
  std::vector<std::uint32_t> landmarks_;
  std::vector<std::uint32_t> first_rows_;  // and the end; empty where each landmark has one
  std::vector<std::uint32_t> numbers_;     // in the map; empty where first_rows_ is
  // Joined rows; empty where these are the map's.
  std::vector<std::int8_t> codes_;
  std::vector<std::uint32_t> cells_;
};

}  // namespace protomark
