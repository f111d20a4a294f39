#include "map/seal_rows.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>
#include <queue>
#include <span>
#include <utility>

#include "base/rounded_mean.h"
#include "map/prune.h"

namespace protomark {
namespace {

// A sealed map has a byte for the number of a landmark's prototypes.
constexpr std::size_t kMaxRows = 255;

// Sums and counts of one landmark's rows.
struct LandmarkRows {
  LandmarkRows(const PrototypeStore& store, std::uint32_t landmark) {
    for (const std::uint32_t row : store.sorted_rows(landmark)) {
      sums.insert(sums.end(), store.sum(row), store.sum(row) + store.dim());
      counts.push_back(store.count(row));
    }
  }
  std::vector<std::int16_t> sums;
  std::vector<std::uint8_t> counts;
};

// The joins of all landmarks, and how many of each one's are made.
class Joins {
 public:
  // The cheapest first over the whole map, of equals that of the first landmark, until there are at
  // most `most` rows.
  Joins(const PrototypeStore& store, std::span<const std::uint32_t> landmarks, double most)
      : ends_(landmarks.size()), made_(landmarks.size()) {
    std::size_t rows = store.rows();
    using Next = std::pair<double, std::size_t>;  // cost, number of the landmark
    std::vector<Next> first;
    for (std::size_t i = 0; i < landmarks.size(); ++i) {
      const LandmarkRows own(store, landmarks[i]);
      const auto joins = ward_joins(own.sums, own.counts, store.dim());
      joins_.insert(joins_.end(), joins.begin(), joins.end());
      ends_[i] = joins_.size();
      if (own.counts.size() > kMaxRows) made_[i] = own.counts.size() - kMaxRows;
      rows -= made_[i];
      if (made_[i] < joins.size()) first.emplace_back(of(i)[made_[i]].cost, i);
    }
    std::priority_queue next(std::greater<>(), std::move(first));
    for (; static_cast<double>(rows) > most && !next.empty(); --rows) {
      const std::size_t i = next.top().second;
      next.pop();
      if (++made_[i] < of(i).size()) next.emplace(of(i)[made_[i]].cost, i);
    }
  }

  std::span<const Join> made(std::size_t i) const { return of(i).first(made_[i]); }

 private:
  std::span<const Join> of(std::size_t i) const {
    const std::size_t begin = i == 0 ? 0 : ends_[i - 1];
    return std::span(joins_).subspan(begin, ends_[i] - begin);
  }

  std::vector<Join> joins_;
  std::vector<std::size_t> ends_;  // of each landmark's joins
  std::vector<std::size_t> made_;
};

}  // namespace

SealedRows::SealedRows(const PrototypeStore& store, std::optional<double> prototypes)
    : store_(&store) {
  const std::size_t n = store.landmarks();
  const double all = static_cast<double>(store.rows());
  const double most = prototypes ? std::floor(*prototypes * static_cast<double>(n)) : all;
  bool fits = true;
  for (std::uint32_t i = 0; store.look_bits() != 0 && i < n; ++i) {
    fits = fits && store.rows_of(i) <= kMaxRows;
  }
  if (!fits || all > most) join(most);
}

std::size_t SealedRows::rows_of(std::uint32_t landmark) const {
  return joined_ ? sorted_rows(landmark).size() : store_->rows_of(landmark);
}

std::vector<std::uint32_t> SealedRows::sorted_rows(std::uint32_t landmark) const {
  if (!joined_) return store_->sorted_rows(landmark);
  std::vector<std::uint32_t> result;
  for (std::uint32_t row = joined_->first_rows[landmark];
       row < size() && joined_->landmarks[row] == landmark; ++row) {
    result.push_back(row);
  }
  return result;
}

std::uint32_t SealedRows::landmark_of(std::uint32_t row) const {
  return joined_ ? joined_->landmarks[row] : store_->landmark_of(row);
}

std::size_t SealedRows::rows_in(std::uint32_t cell) const {
  if (!joined_) return store_->blocks().rows(cell);
  return joined_->cell_ends[cell] - (cell == 0 ? 0 : joined_->cell_ends[cell - 1]);
}

std::uint32_t SealedRows::cell_of(std::uint32_t row) const {
  return joined_ ? joined_->cells[row] : store_->blocks().list_of({row});
}

void SealedRows::visit_sorted_rows(std::uint32_t cell, const PrototypeStore::Visit& visit) const {
  if (!joined_) {
    store_->visit_sorted_rows(cell, visit);
    return;
  }
  const std::size_t n = rows_in(cell);
  visit(std::span(joined_->by_cell).subspan(joined_->cell_ends[cell] - n, n));
}

void SealedRows::code(std::uint32_t row, std::int8_t* to) const {
  if (joined_) {
    std::copy_n(&joined_->codes[row * dim()], dim(), to);
  } else {
    store_->rounded(row, to);
  }
}

void SealedRows::join(double most) {
  const std::vector<std::uint32_t> landmarks = store_->sorted_landmarks();
  const Joins joins(*store_, landmarks, most);
  const std::size_t dim = this->dim();
  Joined result;
  result.first_rows.resize(landmarks.size());
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkRows own(*store_, landmarks[i]);
    std::vector<std::int64_t> sums(own.sums.begin(), own.sums.end());
    std::vector<std::int64_t> counts(own.counts.begin(), own.counts.end());
    for (const Join& join : joins.made(i)) {
      for (std::size_t d = 0; d < dim; ++d) sums[join.into * dim + d] += sums[join.from * dim + d];
      counts[join.into] += std::exchange(counts[join.from], 0);
    }
    result.first_rows[landmarks[i]] = static_cast<std::uint32_t>(result.landmarks.size());
    for (std::size_t row = 0; row < counts.size(); ++row) {
      if (counts[row] == 0) continue;
      for (std::size_t d = 0; d < dim; ++d) {
        result.codes.push_back(rounded_mean(sums[row * dim + d], counts[row]));
      }
      result.landmarks.push_back(landmarks[i]);
    }
  }
  const std::size_t rows = result.landmarks.size();
  const CoarseQuantizer& cells = store_->cells();
  result.cells = cells.nlist() != 0 ? cells.assign({result.codes.data(), rows, dim}, 1)
                                    : std::vector<std::uint32_t>(rows, 0);
  result.by_cell.resize(rows);
  result.cell_ends.resize(std::max<std::size_t>(cells.nlist(), 1), 0);
  for (const std::uint32_t cell : result.cells) ++result.cell_ends[cell];
  std::partial_sum(result.cell_ends.begin(), result.cell_ends.end(), result.cell_ends.begin());
  std::vector<std::uint32_t> next = result.cell_ends;
  for (std::size_t row = rows; row-- > 0;) {
    result.by_cell[--next[result.cells[row]]] = static_cast<std::uint32_t>(row);
  }
  joined_ = std::move(result);
}

}  // namespace protomark
