// What an open map holds in memory: landmarks, and rows, one for each prototype.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "fair_shared_mutex.h"
#include "id_index.h"
#include "protomark/prototypes.h"

namespace protomark {

// Neither landmarks nor rows are sorted. Without looks a row is a landmark and has its number; with
// them, the rows of a landmark are a chain. What goes is replaced by the last one, so numbers of
// landmarks and rows hold until the next one goes.
class PrototypeStore {
 public:
  static constexpr std::uint32_t kNone = IdIndex::kNone;

  PrototypeStore(std::size_t dim, std::size_t look_bits) : dim_(dim), look_bits_(look_bits) {}

  std::size_t dim() const { return dim_; }
  std::size_t look_bits() const { return look_bits_; }
  std::size_t landmarks() const { return ids_.size(); }
  std::size_t rows() const { return counts_.size(); }
  const std::vector<std::int64_t>& ids() const { return ids_; }

  // Bit j is set where code[j] > 0, j < look_bits.
  std::uint16_t look_of(const std::int8_t* code) const;

  void reserve(std::size_t landmarks, std::size_t rows);
  // The landmark of an id, or kNone; `at` throws UnknownLandmark.
  std::uint32_t find(std::int64_t id) const { return index_.find(ids_, id); }
  std::uint32_t at(std::int64_t id) const;
  // The row of a landmark's look, or kNone.
  std::uint32_t find_row(std::uint32_t landmark, std::uint16_t look) const;
  std::uint32_t find_or_create_row(std::int64_t id, std::uint16_t look);
  // Take an id that is not there yet, and a look that the landmark does not have. A new landmark
  // needs a row at once; a new row has a sum and count of zero.
  std::uint32_t create_landmark(std::int64_t id);
  std::uint32_t create_row(std::uint32_t landmark, std::uint16_t look);
  // Afterwards the next create_row does not throw for want of memory.
  void make_room_for_row();
  // With its last row a landmark leaves.
  void erase_row(std::uint32_t row);
  void erase(std::int64_t id);

  // Rows of a landmark, in no order: first_row, next_row of it and so on to kNone.
  std::uint32_t first_row(std::uint32_t landmark) const {
    return look_bits_ == 0 ? landmark : heads_[landmark];
  }
  std::uint32_t next_row(std::uint32_t row) const { return look_bits_ == 0 ? kNone : next_[row]; }
  std::uint32_t landmark_of(std::uint32_t row) const {
    return look_bits_ == 0 ? row : owners_[row];
  }
  std::uint16_t look(std::uint32_t row) const { return look_bits_ == 0 ? 0 : looks_[row]; }

  // Number of a landmark's rows, and of observations in them.
  std::size_t rows_of(std::uint32_t landmark) const;
  std::uint32_t observations(std::uint32_t landmark) const;

  // Landmarks by id, and rows by id and then look.
  std::vector<std::uint32_t> sorted_landmarks() const;
  std::vector<std::uint32_t> sorted_rows() const;
  // Rows of one landmark by look.
  std::vector<std::uint32_t> sorted_rows(std::uint32_t landmark) const;

  std::int16_t* sum(std::uint32_t row) { return &sums_[row * dim_]; }
  const std::int16_t* sum(std::uint32_t row) const { return &sums_[row * dim_]; }
  std::uint8_t count(std::uint32_t row) const { return counts_[row]; }
  void set_count(std::uint32_t row, int count) { counts_[row] = static_cast<std::uint8_t>(count); }
  std::int8_t rounded(std::uint32_t row, std::size_t d) const {
    return packed_[packed_index(row, d, dim_)];
  }

  // Eq. 2; the rounded mean follows with `refresh`.
  void add(std::uint32_t row, const std::int8_t* code);
  // Adds another sum and count, and halves where the count does not fit.
  void join(std::uint32_t row, const std::int16_t* sum, int count);
  void refresh(std::uint32_t row);

  void set_position(std::uint32_t landmark, const Position& position);
  Position position(std::uint32_t landmark) const;
  // Empty while no landmark has ever had one, else one for each landmark.
  const std::vector<Position>& positions() const { return positions_; }

  PackedPrototypes view() const;

 private:
  std::uint32_t* link_to(std::uint32_t row);
  void move_last_row(std::uint32_t to);
  void erase_landmark(std::uint32_t landmark);

  std::size_t dim_;
  std::size_t look_bits_;

  std::vector<std::int64_t> ids_;
  std::vector<Position> positions_;
  IdIndex index_;
  std::vector<std::uint32_t> heads_;  // first row; empty without looks

  std::vector<std::int16_t> sums_;  // rows x dim
  std::vector<std::uint8_t> counts_;
  std::vector<std::int8_t> packed_;    // rounded means, see PackedPrototypes
  std::vector<std::uint16_t> looks_;   // empty without looks
  std::vector<std::uint32_t> owners_;  // landmark of a row; empty without looks
  std::vector<std::uint32_t> next_;    // row of the same landmark; empty without looks
};

// What users do not see of an open map.
struct PrototypeMap::Store : PrototypeStore {
  using PrototypeStore::PrototypeStore;
  mutable FairSharedMutex mutex;
};

bool is_nowhere(const Position& position);

// sum / n rounded to the nearest integer, halves away from zero.
template <typename Integer>
std::int8_t rounded_mean(Integer sum, Integer n) {
  const Integer magnitude = (2 * std::abs(sum) + n) / (2 * n);
  return static_cast<std::int8_t>(sum < 0 ? -magnitude : magnitude);
}

}  // namespace protomark
