#include "map/sealed_rows.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numeric>
#include <queue>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>

#include "base/rounded_mean.h"
#include "map/merge_cost.h"
#include "protomark/search.h"

namespace protomark {
namespace {

// A sealed map has a byte for the number of a landmark's prototypes.
constexpr std::size_t kMaxRows = 255;

std::size_t prototype_bytes(std::size_t dim, int bits) {
  return (bits == 8 ? packed_size(kPackedRows, dim) : packed4_size(kPackedRows, dim)) / kPackedRows;
}

// Sums and counts of one landmark's rows.
struct LandmarkRows {
  LandmarkRows(const PrototypeStore& store, LandmarkIndex landmark) {
    for (const Row row : store.sorted_rows(landmark)) {
      sums.insert(sums.end(), store.sum(row), store.sum(row) + store.dim());
      counts.push_back(static_cast<std::uint8_t>(store.count(row)));
    }
  }
  std::vector<std::int16_t> sums;
  std::vector<std::uint8_t> counts;
};

// The merges of all landmarks, and how many of each one's are made.
class Merges {
 public:
  // Makes those of least cost over the whole map first, of equals that of the first landmark, until
  // there are at most `limit` rows.
  Merges(const PrototypeStore& store, std::span<const LandmarkIndex> landmarks, std::size_t limit)
      : ends_(landmarks.size()), made_(landmarks.size()) {
    std::size_t rows = store.prototype_count();
    using Next = std::pair<double, std::size_t>;  // cost, index in landmarks
    std::vector<Next> first;
    for (std::size_t i = 0; i < landmarks.size(); ++i) {
      const LandmarkRows own(store, landmarks[i]);
      const auto merges = appearance_merges(own.sums, own.counts, store.dim());
      merges_.insert(merges_.end(), merges.begin(), merges.end());
      ends_[i] = merges_.size();
      if (own.counts.size() > kMaxRows) made_[i] = own.counts.size() - kMaxRows;
      rows -= made_[i];
      if (made_[i] < merges.size()) first.emplace_back(of(i)[made_[i]].cost, i);
    }
    std::priority_queue next(std::greater<>(), std::move(first));
    for (; rows > limit && !next.empty(); --rows) {
      const std::size_t i = next.top().second;
      next.pop();
      if (++made_[i] < of(i).size()) next.emplace(of(i)[made_[i]].cost, i);
    }
  }

  std::span<const AppearanceMerge> made(std::size_t i) const { return of(i).first(made_[i]); }

 private:
  std::span<const AppearanceMerge> of(std::size_t i) const {
    const std::size_t begin = i == 0 ? 0 : ends_[i - 1];
    return std::span(merges_).subspan(begin, ends_[i] - begin);
  }

  std::vector<AppearanceMerge> merges_;
  std::vector<std::size_t> ends_;  // of each landmark's merges
  std::vector<std::size_t> made_;
};

// Calls take(landmark) for all landmarks.
template <typename Take>
void each_landmark(const PrototypeStore& store, const Take& take) {
  for (LandmarkIndex l{0}; l.value < store.ids().size(); ++l.value) {
    if (store.id(l) >= 0) take(l);
  }
}

}  // namespace

std::size_t sealed_bytes(std::size_t landmarks, std::size_t rows, std::size_t dim, int bits) {
  return rows * prototype_bytes(dim, bits) + landmarks * (rows > landmarks ? 2 : 1);
}

SealFormat seal_format(const PrototypeStore& store, std::optional<double> bytes_per_landmark) {
  const std::size_t n = store.landmark_count(), dim = store.dim();
  std::size_t rows = store.prototype_count();
  if (store.several()) {
    each_landmark(store, [&](LandmarkIndex l) {
      rows -= store.row_count(l) - std::min(store.row_count(l), kMaxRows);
    });
  }
  if (!bytes_per_landmark) return {8, rows};
  const std::size_t smallest = sealed_bytes(1, 1, dim, 4);
  if (!(*bytes_per_landmark >= static_cast<double>(smallest))) {
    throw std::invalid_argument("bytes_per_landmark must be at least " + std::to_string(smallest) +
                                " for this map, which one prototype of 4 bits per number takes, "
                                "not " +
                                std::to_string(*bytes_per_landmark));
  }
  // What a product of doubles loses must not cost a prototype.
  const double budget = *bytes_per_landmark * static_cast<double>(n) * (1 + 1e-12);
  const auto fits = [&](std::size_t m, int bits) {
    return static_cast<double>(sealed_bytes(n, m, dim, bits)) <= budget;
  };
  if (fits(rows, 8)) return {8, rows};
  if (fits(rows, 4)) return {4, rows};
  const double limit =
      (budget - 2 * static_cast<double>(n)) / static_cast<double>(prototype_bytes(dim, 4));
  return {4, std::max(n, static_cast<std::size_t>(std::max(limit, 0.0)))};
}

SealedRows::SealedRows(const PrototypeStore& store, std::size_t limit) : store_(&store) {
  if (!store.several()) return;
  bool fits = store.prototype_count() <= limit;
  each_landmark(store, [&](LandmarkIndex l) { fits = fits && store.row_count(l) <= kMaxRows; });
  if (!fits) merge(limit);
}

std::size_t SealedRows::row_count(LandmarkIndex landmark) const {
  return merged_ ? sorted_rows(landmark).size() : store_->row_count(landmark);
}

std::vector<Row> SealedRows::sorted_rows(LandmarkIndex landmark) const {
  if (!merged_) return store_->sorted_rows(landmark);
  std::vector<Row> result;
  for (Row row = merged_->first_rows[landmark.value];
       row.value < size() && merged_->owners[row.value] == landmark; ++row.value) {
    result.push_back(row);
  }
  return result;
}

LandmarkIndex SealedRows::owner(Row row) const {
  return merged_ ? merged_->owners[row.value] : store_->owner(row);
}

std::size_t SealedRows::rows_in(std::uint32_t list) const {
  if (!merged_) return store_->lists().rows(list);
  return merged_->list_ends[list] - (list == 0 ? 0 : merged_->list_ends[list - 1]);
}

std::uint32_t SealedRows::list_of(Row row) const {
  return merged_ ? merged_->lists[row.value] : store_->lists().cell_of(row.value);
}

void SealedRows::visit_sorted_rows(std::uint32_t list,
                                   const PrototypeStore::VisitRows& visit) const {
  if (!merged_) return store_->visit_sorted_rows(list, visit);
  const std::size_t n = rows_in(list);
  visit(std::span(merged_->by_list).subspan(merged_->list_ends[list] - n, n));
}

void SealedRows::code(Row row, std::int8_t* to) const {
  if (!merged_) return store_->rounded(row, to);
  std::copy_n(&merged_->codes[row.value * dim()], dim(), to);
}

void SealedRows::merge(std::size_t limit) {
  const std::vector<LandmarkIndex> landmarks = store_->sorted_landmarks();
  const Merges merges(*store_, landmarks, limit);
  const std::size_t dim = this->dim();
  Merged result;
  result.first_rows.resize(landmarks.size());
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkRows own(*store_, landmarks[i]);
    std::vector<std::int64_t> sums(own.sums.begin(), own.sums.end());
    std::vector<std::int64_t> counts(own.counts.begin(), own.counts.end());
    for (const AppearanceMerge& m : merges.made(i)) {
      for (std::size_t d = 0; d < dim; ++d) sums[m.into * dim + d] += sums[m.source * dim + d];
      counts[m.into] += std::exchange(counts[m.source], 0);
    }
    result.first_rows[landmarks[i].value].value = static_cast<std::uint32_t>(result.owners.size());
    for (std::size_t row = 0; row < counts.size(); ++row) {
      if (counts[row] == 0) continue;
      for (std::size_t d = 0; d < dim; ++d) {
        result.codes.push_back(rounded_mean(sums[row * dim + d], counts[row]));
      }
      result.owners.push_back(landmarks[i]);
    }
  }
  const std::size_t rows = result.owners.size();
  const Cells& centroids = store_->centroids();
  result.lists = centroids.size() != 0 ? centroids.assign({result.codes.data(), rows, dim}, 1)
                                       : std::vector<std::uint32_t>(rows, 0);
  result.list_ends.resize(std::max<std::size_t>(centroids.size(), 1), 0);
  for (const std::uint32_t list : result.lists) ++result.list_ends[list];
  std::partial_sum(result.list_ends.begin(), result.list_ends.end(), result.list_ends.begin());
  std::vector<std::uint32_t> next = result.list_ends;
  result.by_list.resize(rows);
  for (Row row{static_cast<std::uint32_t>(rows)}; row.value-- > 0;) {
    result.by_list[--next[result.lists[row.value]]] = row;
  }
  merged_ = std::move(result);
}

}  // namespace protomark
