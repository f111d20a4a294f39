#include "sealed_rows.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <queue>
#include <span>
#include <utility>

#include "rounded_mean.h"
#include "ward.h"

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
  Joins(const PrototypeStore& store, const std::vector<std::uint32_t>& landmarks, double most)
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
    : store_(&store), landmarks_(store.sorted_landmarks()) {
  const double all = static_cast<double>(store.rows());
  const double most =
      prototypes ? std::floor(*prototypes * static_cast<double>(landmarks_.size())) : all;
  const bool fits = std::all_of(landmarks_.begin(), landmarks_.end(), [&](std::uint32_t landmark) {
    return store.rows_of(landmark) <= kMaxRows;
  });
  if (!fits || all > most) {
    join(most);
  } else if (store.rows() != landmarks_.size()) {
    take();
  }
}

std::size_t SealedRows::landmark_of(std::size_t row) const {
  if (!several()) return row;
  const auto next = std::upper_bound(first_rows_.begin(), first_rows_.end(), row);
  return static_cast<std::size_t>(next - first_rows_.begin()) - 1;
}

void SealedRows::code(std::size_t row, std::int8_t* to) const {
  if (joined()) {
    std::copy_n(&codes_[row * dim()], dim(), to);
  } else {
    store_->rounded(number(row), to);
  }
}

void SealedRows::take() {
  numbers_.reserve(store_->rows());
  first_rows_.reserve(landmarks_.size() + 1);
  for (const std::uint32_t landmark : landmarks_) {
    first_rows_.push_back(static_cast<std::uint32_t>(numbers_.size()));
    const auto rows = store_->sorted_rows(landmark);
    numbers_.insert(numbers_.end(), rows.begin(), rows.end());
  }
  first_rows_.push_back(static_cast<std::uint32_t>(numbers_.size()));
}

void SealedRows::join(double most) {
  const Joins joins(*store_, landmarks_, most);
  const std::size_t dim = this->dim();
  first_rows_.push_back(0);
  for (std::size_t i = 0; i < landmarks_.size(); ++i) {
    const LandmarkRows own(*store_, landmarks_[i]);
    std::vector<std::int64_t> sums(own.sums.begin(), own.sums.end());
    std::vector<std::int64_t> counts(own.counts.begin(), own.counts.end());
    for (const Join& join : joins.made(i)) {
      for (std::size_t d = 0; d < dim; ++d) sums[join.into * dim + d] += sums[join.from * dim + d];
      counts[join.into] += std::exchange(counts[join.from], 0);
    }
    for (std::size_t row = 0; row < counts.size(); ++row) {
      if (counts[row] == 0) continue;
      for (std::size_t d = 0; d < dim; ++d) {
        codes_.push_back(rounded_mean(sums[row * dim + d], counts[row]));
      }
    }
    first_rows_.push_back(static_cast<std::uint32_t>(codes_.size() / dim));
  }
  const std::size_t rows = first_rows_.back();
  if (rows == landmarks_.size()) first_rows_.clear();
  cells_ = store_->cells().size() != 0 ? store_->cells().assign({codes_.data(), rows, dim}, 1)
                                       : std::vector<std::uint32_t>(rows, 0);
}

}  // namespace protomark
