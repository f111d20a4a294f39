#include "map/sealed_store.h"

#include <algorithm>
#include <bit>
#include <functional>
#include <queue>
#include <utility>

#include "base/quantize.h"
#include "base/text.h"
#include "protomark/prototype_map.h"

namespace protomark {
namespace {

// A sealed map stores the number of a landmark's prototypes in a byte.
constexpr std::size_t kMaxRows = 255;

std::size_t prototype_bytes(std::size_t dim, int bits) {
  return (bits == 8 ? packed_size(kPackedRows, dim) : packed4_size(kPackedRows, dim)) / kPackedRows;
}

// Sums and counts of one landmark's rows.
struct LandmarkRows {
  LandmarkRows(const PrototypeStore& store, LandmarkIndex landmark) {
    for (const Row row : store.sorted_rows(landmark)) {
      const Sum sum = store.sum(row);
      sums.insert(sums.end(), sum.begin(), sum.begin() + store.dim());
      counts.push_back(static_cast<std::uint8_t>(store.count(row)));
    }
  }
  std::vector<std::int16_t> sums;
  std::vector<std::uint8_t> counts;
};

// The merges of all landmarks, and how many of each landmark are made.
class Merges {
 public:
  // Makes those of least cost over the whole map, ties to the first landmark, until there are at
  // most `limit` rows.
  Merges(const PrototypeStore& store, std::span<const LandmarkIndex> landmarks, std::size_t limit)
      : ends_(landmarks.size()), made_(landmarks.size()) {
    std::size_t rows = store.prototype_count();
    using Next = std::pair<double, std::size_t>;  // cost, index in landmarks
    std::vector<Next> first;
    for (std::size_t i = 0; i < landmarks.size(); ++i) {
      const LandmarkRows of_landmark(store, landmarks[i]);
      const auto merges = appearance_merges(of_landmark.sums, of_landmark.counts, store.dim());
      merges_.insert(merges_.end(), merges.begin(), merges.end());
      ends_[i] = merges_.size();
      if (merges.size() >= kMaxRows) made_[i] = merges.size() + 1 - kMaxRows;
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

}  // namespace

std::size_t sealed_bytes(std::size_t landmarks, std::size_t rows, std::size_t dim, int bits) {
  return rows * prototype_bytes(dim, bits) + landmarks * (rows > landmarks ? 2 : 1);
}

int owner_bits(std::size_t landmarks) {
  return static_cast<int>(std::bit_width(std::max<std::size_t>(landmarks, 1)));
}

SealFormat seal_format(const PrototypeStore& store, std::optional<double> bytes_per_landmark) {
  const std::size_t n = store.landmark_count(), dim = store.dim();
  std::size_t rows = store.prototype_count();
  store.each_landmark([&](LandmarkIndex l) {
    if (store.several()) rows -= store.row_count(l) - std::min(store.row_count(l), kMaxRows);
  });
  if (!bytes_per_landmark) return {8, rows};
  const std::size_t smallest = sealed_bytes(1, 1, dim, 4);
  if (!(*bytes_per_landmark >= static_cast<double>(smallest))) {
    invalid("bytes_per_landmark must be at least ", smallest,
            " for this map, which one prototype of 4 bits per number takes");
  }
  // The rounding of the product must not cost a prototype.
  const double budget = *bytes_per_landmark * static_cast<double>(n) * (1 + 1e-12);
  for (const int bits : {8, 4}) {
    if (static_cast<double>(sealed_bytes(n, rows, dim, bits)) <= budget) return {bits, rows};
  }
  const double limit =
      (budget - 2 * static_cast<double>(n)) / static_cast<double>(prototype_bytes(dim, 4));
  return {4, std::max(n, static_cast<std::size_t>(std::max(limit, 0.0)))};
}

std::optional<PrototypeStore> merge_appearances(const PrototypeStore& store, std::size_t limit) {
  if (store.prototype_count() <= limit) return std::nullopt;
  const std::vector<LandmarkIndex> landmarks = store.sorted_landmarks();
  const Merges merges(store, landmarks, limit);
  const std::size_t dim = store.dim();
  PrototypeStore result(dim, store.appearance_bits());
  result.reserve(landmarks.size(), std::min(limit, store.prototype_count()));
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkRows before(store, landmarks[i]);
    std::vector<std::int64_t> sums(before.sums.begin(), before.sums.end());
    std::vector<std::int64_t> counts(before.counts.begin(), before.counts.end());
    for (const AppearanceMerge& m : merges.made(i)) {
      for (std::size_t d = 0; d < dim; ++d) sums[m.into * dim + d] += sums[m.source * dim + d];
      counts[m.into] += std::exchange(counts[m.source], 0);
    }
    LandmarkIndex landmark = kNoLandmark;
    for (std::size_t from = 0; from < counts.size(); ++from) {
      if (counts[from] == 0) continue;
      const auto appearance = static_cast<std::uint16_t>(from);
      const Row row = result.create_row(store.id(landmarks[i]), landmark, appearance);
      const bool fits_row = counts[from] <= PrototypeMap::kMaxCount;
      Sum own_sum{};
      for (std::size_t d = 0; d < dim; ++d) {
        const std::int64_t sum = sums[from * dim + d];
        own_sum[d] = fits_row ? static_cast<std::int16_t>(sum) : rounded_mean(sum, counts[from]);
      }
      result.set(row, own_sum, fits_row ? static_cast<int>(counts[from]) : 1);
    }
  }
  if (store.quantizer().nlist() != 0) result.rearrange(result.arrange(store.quantizer(), 1));
  return result;
}

}  // namespace protomark
