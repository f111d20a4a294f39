// The prototypes that a map is sealed with.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "map/prototype_store.h"

namespace protomark {

// How a map is sealed.
struct SealFormat {
  int bits;               // per number of a prototype, 8 or 4
  std::size_t row_limit;  // prototypes in all
};

// Chooses the format for a number of bytes per landmark as SealOptions says. Throws
// std::invalid_argument, with the smallest possible number, if that is too small.
SealFormat seal_format(const PrototypeStore& store, std::optional<double> bytes_per_landmark);

// Bytes that prototypes, their number and counts take of landmarks with so many rows.
std::size_t sealed_bytes(std::size_t landmarks, std::size_t rows, std::size_t dim, int bits);

// Rounded prototypes. If none has to be merged they are those of the store, which must not change
// meanwhile, with the rows of the store; otherwise rows are counted by id and then appearance.
class SealedRows {
 public:
  // At most `limit` rows, and 255 of any landmark.
  SealedRows(const PrototypeStore& store, std::size_t limit);

  const PrototypeStore& store() const { return *store_; }
  std::size_t dim() const { return store_->dim(); }
  std::size_t size() const { return merged_ ? merged_->owners.size() : store_->prototype_count(); }
  // Whether any landmark has several rows.
  bool several() const { return size() != store_->landmark_count(); }

  // The rows of a landmark of the store, by appearance.
  std::size_t row_count(LandmarkIndex landmark) const;
  std::vector<Row> sorted_rows(LandmarkIndex landmark) const;
  // Calls take(row) for each of these.
  template <typename Take>
  void each_sorted_row(LandmarkIndex landmark, const Take& take) const {
    if (!store_->several()) return take(store_->first_row(landmark));
    for (const Row row : sorted_rows(landmark)) take(row);
  }
  // The landmark of the store that a row is of.
  LandmarkIndex owner(Row row) const;
  // Inverted lists; list 0 has all rows without an index.
  std::size_t rows_in(std::uint32_t list) const;
  std::uint32_t list_of(Row row) const;
  // Hands over the rows of a list by id and then appearance, piece by piece.
  void visit_sorted_rows(std::uint32_t list, const PrototypeStore::VisitRows& visit) const;
  // Calls take(row) for all rows, in no order.
  template <typename Take>
  void each_row(const Take& take) const {
    const std::size_t end = merged_ ? size() : store_->row_end();
    for (Row row{0}; row.value < end; ++row.value) {
      if (merged_ || store_->is_row(row)) take(row);
    }
  }
  void code(Row row, std::int8_t* to) const;

 private:
  struct Merged {
    std::vector<std::int8_t> codes;
    std::vector<LandmarkIndex> owners;  // of each row
    std::vector<Row> first_rows;        // of each landmark
    std::vector<std::uint32_t> lists;   // of each row
    std::vector<Row> by_list;
    std::vector<std::uint32_t> list_ends;  // in by_list
  };
  void merge(std::size_t limit);

  const PrototypeStore* store_;
  std::optional<Merged> merged_;
};

}  // namespace protomark
