// Compiled without contraction of products and sums (core/CMakeLists.txt).
#include "map/sealed_store.h"

#include <numeric>
#include <queue>

#include "protomark/prototype_map.h"

namespace protomark {
namespace {

// A sealed map stores the number of a landmark's prototypes in a byte.
constexpr size_t kMaxRows = 255;

// Words of fewer numbers are better from so many times as many on (measured on caliterra). Without
// observations to tune by, so many prototypes per landmark are worth more than longer ones once
// these have so many numbers (caliterra, viking and conch).
constexpr double kMoreWords = 1.1, kWorthwhile = 1.25;
constexpr size_t kEnoughNumbers = 48;

// Sums of the first `dim` numbers and counts of one landmark's rows.
struct LandmarkSums {
  LandmarkSums(const PrototypeStore& store, LandmarkIndex landmark, size_t dim) {
    for (const Row row : store.sorted_rows(landmark)) {
      const Sum sum = store.sum(row);
      sums.insert(sums.end(), sum.begin(), sum.begin() + dim);
      counts.push_back(static_cast<uint8_t>(store.count(row)));
    }
  }
  std::vector<int16_t> sums;
  std::vector<uint8_t> counts;
};

// Comparing all pairs of more rows of a landmark would take seconds to minutes.
constexpr size_t kMaxCompared = 2048;

// Returns |a/n - b/m|^2 n m / (n + m) = |m a - n b|^2 / (n m (n + m)) for whole numbers. All but
// the division is exact below 2^53, which no real landmark exceeds.
double merge_cost(const double* a, double n, const double* b, double m, size_t dim) {
  // Four sums, so that a compiler may use vectors without changing the order of additions.
  double part[4] = {};
  size_t d = 0;
  for (; d + 4 <= dim; d += 4) {
    for (size_t k = 0; k < 4; ++k) {
      const double difference = m * a[d + k] - n * b[d + k];
      part[k] += difference * difference;
    }
  }
  for (; d < dim; ++d) {
    const double difference = m * a[d] - n * b[d];
    part[d % 4] += difference * difference;
  }
  return ((part[0] + part[1]) + (part[2] + part[3])) / (n * m * (n + m));
}

struct Words {
  size_t numbers() const { return codebook == nullptr ? 0 : count * codebook->width; }

  const Codebook* codebook = nullptr;
  size_t count = 0;
};

// Returns the best words for up to `dim` numbers; none if bytes are too few for the shortest codes.
Words best_words(const Encoder& encoder, size_t dim, double bytes) {
  Words best;
  for (const Codebook& codebook : encoder.codebooks()) {
    const size_t longest = std::min(dim / codebook.width, codebook.subspaces());
    const auto count = static_cast<size_t>(std::clamp(bytes, 0.0, static_cast<double>(longest)));
    if (count * codebook.width < encoder.dims().front()) continue;
    const auto more = static_cast<double>(count), most = static_cast<double>(best.count);
    const bool narrower = best.codebook == nullptr || codebook.width < best.codebook->width;
    if (narrower ? more >= kMoreWords * most : most < kMoreWords * more) best = {&codebook, count};
  }
  return best;
}

}  // namespace

// Muellner's generic algorithm ("Modern hierarchical, agglomerative clustering algorithms", 2011).
std::vector<AppearanceMerge> appearance_merges(std::span<const int16_t> sums,
                                               std::span<const uint8_t> counts, size_t dim) {
  std::vector<double> sum(sums.begin(), sums.end()), count(counts.begin(), counts.end());
  std::vector<AppearanceMerge> merges;
  const auto merge = [&](size_t into, size_t source, double cost) {
    merges.push_back({cost, static_cast<uint16_t>(into), static_cast<uint16_t>(source)});
    for (size_t d = 0; d < dim; ++d) sum[into * dim + d] += sum[source * dim + d];
    count[into] += count[source];
  };
  std::vector<size_t> remaining(counts.size());  // ascending
  std::iota(remaining.begin(), remaining.end(), size_t{0});
  // Merges each second row into the one before it.
  while (remaining.size() > kMaxCompared) {
    std::vector<size_t> halved;
    for (size_t at = 0; at < remaining.size(); at += 2) {
      halved.push_back(remaining[at]);
      if (at + 1 < remaining.size()) merge(remaining[at], remaining[at + 1], 0.0);
    }
    remaining = std::move(halved);
  }
  // Of all but the last that remains, the later row of least cost, and that cost.
  std::vector<size_t> partner(counts.size(), 0);
  std::vector<double> least(counts.size(), 0);
  const auto offer = [&](size_t row, size_t other) {
    const double cost =
        merge_cost(&sum[row * dim], count[row], &sum[other * dim], count[other], dim);
    if (std::pair(cost, other) < std::pair(least[row], partner[row])) {
      least[row] = cost;
      partner[row] = other;
    }
  };
  const auto find_partner = [&](size_t at) {
    least[remaining[at]] = std::numeric_limits<double>::infinity();
    for (size_t i = at + 1; i < remaining.size(); ++i) offer(remaining[at], remaining[i]);
  };
  for (size_t at = 0; at + 1 < remaining.size(); ++at) find_partner(at);
  while (remaining.size() > 1) {
    size_t best = 0;
    for (size_t at = 1; at + 1 < remaining.size(); ++at) {
      if (least[remaining[at]] < least[remaining[best]]) best = at;
    }
    const size_t into = remaining[best], source = partner[into];
    merge(into, source, least[into]);
    std::erase(remaining, source);
    for (size_t at = 0; at + 1 < remaining.size() && remaining[at] < source; ++at) {
      const size_t row = remaining[at];
      if (at == best || partner[row] == into || partner[row] == source) {
        find_partner(at);
      } else if (at < best) {
        offer(row, into);
      }
    }
  }
  return merges;
}

size_t sealed_bytes(size_t landmarks, size_t rows, size_t row_bytes) {
  return rows * row_bytes + (rows > landmarks ? landmarks : 0);
}

int owner_bits(size_t landmarks) {
  return static_cast<int>(std::bit_width(std::max<size_t>(landmarks, 1)));
}

SealFormat seal_format(const PrototypeStore& store, const Encoder& encoder,
                       std::optional<double> bytes_per_landmark, bool observed) {
  const size_t n = store.landmark_count(), dim = store.dim();
  size_t rows = store.prototype_count();
  store.each_landmark([&](LandmarkIndex l) {
    if (store.several()) rows -= store.row_count(l) - std::min(store.row_count(l), kMaxRows);
  });
  const SealFormat lossless{dim, nullptr, rows};
  if (!bytes_per_landmark) return lossless;
  // The rounding of products must not cost a prototype.
  const double limit = *bytes_per_landmark * (1 + 1e-12), landmarks = static_cast<double>(n);
  // Returns how many prototypes of so many bytes fit, at least one per landmark.
  const auto fitting = [&](size_t row_bytes) {
    if (static_cast<double>(sealed_bytes(n, rows, row_bytes)) <= limit * landmarks) return rows;
    const double several = (limit - 1) * landmarks / static_cast<double>(row_bytes);
    return std::max(n, static_cast<size_t>(std::max(0.0, several)));
  };
  size_t smallest = 1;
  while (smallest < packed_dim(dim) &&
         best_words(encoder, dim, static_cast<double>(smallest)).count == 0) {
    ++smallest;
  }
  const bool enough = limit >= static_cast<double>(smallest);
  if (enough && static_cast<double>(sealed_bytes(n, rows, packed_dim(dim))) <= limit * landmarks) {
    return lossless;
  }
  require(best_words(encoder, dim, static_cast<double>(dim)).count != 0,
          "bytes_per_landmark needs codebooks, which encoder '", encoder.info().name,
          "' does not have for this map: give it some, or seal the map as it is, without "
          "bytes_per_landmark");
  require(enough, "bytes_per_landmark must be at least ", smallest,
          " for this map, which one prototype of ", smallest, " words takes");
  if (!observed && static_cast<double>(rows) >= kWorthwhile * landmarks) {
    const Words several = best_words(encoder, dim, (limit - 1) / kWorthwhile);
    if (several.numbers() >= kEnoughNumbers) {
      return {several.numbers(), several.codebook, fitting(several.count)};
    }
  }
  const Words most = best_words(encoder, dim, limit);
  return {most.numbers(), most.codebook, fitting(most.count)};
}

std::optional<PrototypeStore> merge_appearances(const PrototypeStore& store, size_t dim,
                                                size_t limit) {
  if (store.prototype_count() <= limit && dim == store.dim()) return std::nullopt;
  const std::vector<LandmarkIndex> landmarks = store.sorted_landmarks();
  // Merges of all landmarks, the end of those of each, and the number of those that are made.
  std::vector<AppearanceMerge> merges;
  std::vector<size_t> ends, made;
  const auto merges_of = [&](size_t i) {
    const size_t begin = i == 0 ? 0 : ends[i - 1];
    return std::span(merges).subspan(begin, ends[i] - begin);
  };
  // Makes those of least cost over the whole map, ties to the first landmark.
  using Next = std::pair<double, size_t>;  // cost, index in landmarks
  std::vector<Next> first;
  size_t rows = store.prototype_count();
  for (size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkSums of_landmark(store, landmarks[i], dim);
    const auto all = appearance_merges(of_landmark.sums, of_landmark.counts, dim);
    merges.insert(merges.end(), all.begin(), all.end());
    ends.push_back(merges.size());
    made.push_back(all.size() >= kMaxRows ? all.size() + 1 - kMaxRows : 0);
    rows -= made[i];
    if (made[i] < all.size()) first.emplace_back(all[made[i]].cost, i);
  }
  std::priority_queue next(std::greater<>(), std::move(first));
  for (; rows > limit && !next.empty(); --rows) {
    const size_t i = next.top().second;
    next.pop();
    if (++made[i] < merges_of(i).size()) next.emplace(merges_of(i)[made[i]].cost, i);
  }
  PrototypeStore result(dim, store.appearance_bits());
  result.reserve(landmarks.size(), std::min(limit, store.prototype_count()));
  for (size_t i = 0; i < landmarks.size(); ++i) {
    const LandmarkSums before(store, landmarks[i], dim);
    std::vector<int64_t> sums(before.sums.begin(), before.sums.end());
    std::vector<int64_t> counts(before.counts.begin(), before.counts.end());
    for (const AppearanceMerge& m : merges_of(i).first(made[i])) {
      for (size_t d = 0; d < dim; ++d) sums[m.into * dim + d] += sums[m.source * dim + d];
      counts[m.into] += std::exchange(counts[m.source], 0);
    }
    LandmarkIndex landmark = kNoLandmark;
    for (size_t from = 0; from < counts.size(); ++from) {
      if (counts[from] == 0) continue;
      const auto appearance = static_cast<uint16_t>(from);
      const Row row = result.create_row(store.id(landmarks[i]), landmark, appearance);
      const bool fits_row = counts[from] <= PrototypeMap::kMaxCount;
      Sum own_sum{};
      for (size_t d = 0; d < dim; ++d) {
        const int64_t sum = sums[from * dim + d];
        own_sum[d] = fits_row ? static_cast<int16_t>(sum) : rounded_mean(sum, counts[from]);
      }
      result.set(row, own_sum, fits_row ? static_cast<int>(counts[from]) : 1);
    }
  }
  if (store.quantizer().nlist() != 0) {
    result.rearrange(result.arrange(store.quantizer().cut(dim), 1));
  }
  return result;
}

}  // namespace protomark
