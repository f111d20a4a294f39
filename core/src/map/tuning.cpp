// Compiled without contraction of products and sums (core/CMakeLists.txt).
#include "map/sealed_store.h"

#include <numeric>

#include "base/parallel.h"
#include "search/inverted_lists.h"

namespace protomark {
namespace {

// Prototypes move `kPasses` times by the prototypes that were nearest at the begin of a round.
constexpr int kRounds = 3, kPasses = 4;
constexpr double kStep = 0.35;
// A prototype may be mistaken for the own one if exp(-d / T) is at least exp(-kReach) of its.
constexpr int kReach = 8;
// The nearest prototypes of a query that are looked at, and the lists in which they are searched.
constexpr size_t kNearest = 16, kLists = 16;
// Without an index, more prototypes get lists, as comparing all with all would take hours.
constexpr size_t kManyRows = 1 << 16;
constexpr size_t kPiece = 1 << 14;  // queries that are searched for at a time
constexpr int kFraction = 4;  // bits of a number behind the point, so that 32 bits hold a distance
constexpr int kUnit = 1 << 15;  // of a probability
// The sum of weights up to which their products with codes fit 32 bits.
constexpr int64_t kPartWeight = (1 << 24) - 1;

// Returns 2^30 exp(-i / 64), equal on every machine.
const std::vector<uint32_t>& exponentials() {
  static const std::vector<uint32_t> table = [] {
    constexpr uint64_t kFactor = 4228380000;  // 2^32 exp(-1 / 64)
    std::vector<uint32_t> result{1u << 30};
    while (result.back() >= 1u << 10) {
      result.push_back(static_cast<uint32_t>(result.back() * kFactor >> 32));
    }
    return result;
  }();
  return table;
}

// A prototype that a query pulls or pushes.
struct Force {
  uint32_t query;
  uint32_t rank;  // of the row
};

class Tuner {
 public:
  Tuner(const PrototypeStore& store, const TuningQueries& queries, int threads)
      : tuned_(store),
        indexed_(store.quantizer().nlist() != 0),
        queries_(queries),
        threads_(threads),
        dim_(store.dim()) {
    tuned_.uncommitted = nullptr;  // the map does not change
    if (!indexed_ && tuned_.prototype_count() > kManyRows) {
      const size_t nlist =
          CoarseQuantizer::default_nlist(tuned_.prototype_count(), dim_, tuned_.row_bytes());
      tuned_.rearrange(tuned_.arrange(tuned_.learn_quantizer(nlist, threads), threads));
    }
    rank_rows();
    find_own();
  }

  PrototypeStore run() {
    for (int round = 0; round < kRounds; ++round) {
      find_rivals();
      for (int pass = 0; pass < kPasses; ++pass) move();
      store_rounded();
    }
    if (indexed_) {
      tuned_.reassign(threads_);
    } else if (tuned_.quantizer().nlist() != 0) {
      tuned_.rearrange(tuned_.arrange({}, threads_));
    }
    return std::move(tuned_);
  }

 private:
  // Ranks rows by id and appearance, as their places in memory depend on the map's history.
  void rank_rows() {
    rows_ = tuned_.sorted_rows(tuned_.sorted_landmarks());
    rank_of_row_.assign(tuned_.row_end(), -1);
    means_ = Matrix<int8_t>(rows_.size(), dim_);
    for (size_t rank = 0; rank < rows_.size(); ++rank) {
      rank_of_row_[rows_[rank].value] = static_cast<int64_t>(rank);
      tuned_.rounded(rows_[rank], means_.row(rank));
      counts_.push_back(static_cast<uint32_t>(tuned_.count(rows_[rank])));
    }
    for (const int8_t x : means_.data) {
      numbers_.push_back(static_cast<int16_t>(x * (1 << kFraction)));
    }
  }

  // Rounds all prototypes into the store, where they stay in their rows.
  void store_rounded() {
    for (size_t rank = 0; rank < rows_.size(); ++rank) {
      Sum sum{};
      for (size_t d = 0; d < dim_; ++d) {
        // NOLINTNEXTLINE(bugprone-signed-char-misuse): a number, no character
        sum[d] = rounded_mean<int>(numbers_[rank * dim_ + d], 1 << kFraction);
      }
      tuned_.set(rows_[rank], sum, 1);
    }
  }

  // Finds the own prototype of each query, the nearest one of its landmark, and the temperature.
  void find_own() {
    const size_t n = queries_.landmarks.size();
    own_.assign(n, UINT32_MAX);
    std::vector<int32_t> distances(n, 0);
    parallel_for(threads_, n, 64, [&](size_t begin, size_t end) {
      for (size_t q = begin; q < end; ++q) {
        const LandmarkIndex landmark = tuned_.find(queries_.landmarks[q]);
        if (landmark == kNoLandmark) continue;
        distances[q] = INT32_MAX;
        tuned_.each_row_of(landmark, [&](Row row) {
          const auto rank = static_cast<uint32_t>(rank_of_row_[row.value]);
          const int32_t d = squared_distance(queries_.codes.row(q), means_.row(rank), dim_);
          std::tie(distances[q], own_[q]) =
              std::min(std::pair(distances[q], own_[q]), std::pair(d, rank));
        });
      }
    });
    std::vector<uint32_t> observed(rows_.size(), 0);
    for (size_t q = 0; q < n; ++q) {
      if (own_[q] != UINT32_MAX) observed[own_[q]] += queries_.weights[q];
    }
    for (size_t i = 0; i < observed.size(); ++i) counts_[i] = std::max(counts_[i], observed[i]);
    // Means of several observations are nearer to their prototypes than what they stand for, and
    // count only where there is nothing else.
    std::array<uint64_t, 2> sums{}, weights{};
    for (uint32_t q = 0; q < n; ++q) {
      if (own_[q] == UINT32_MAX || rest(q) == 0) continue;
      contested_.push_back(q);
      const size_t kind = queries_.weights[q] == 1 ? 0 : 1;
      sums[kind] += uint64_t{queries_.weights[q]} * static_cast<uint64_t>(distances[q]);
      weights[kind] += queries_.weights[q];
    }
    const size_t kind = weights[0] != 0 ? 0 : 1;
    temperature_ = std::max<int64_t>(
        1, static_cast<int64_t>(sums[kind] / std::max<uint64_t>(4 * weights[kind], 1)));
  }

  // Returns how many other observations the own prototype of a query has.
  uint32_t rest(size_t q) const { return counts_[own_[q]] - queries_.weights[q]; }

  // Finds what contested queries could be mistaken for; those without rivals are so no longer.
  void find_rivals() {
    PackedPrototypes view = tuned_.view();
    view.landmarks = {};
    view.landmarks.ids = rank_of_row_.data();
    const SearchOptions options{.threads = threads_};
    const std::vector<uint32_t> before = std::exchange(contested_, {});
    firsts_.clear();
    forces_.clear();
    Matrix<int8_t> codes(std::min(kPiece, before.size()), dim_);
    for (size_t first = 0; first < before.size(); first += kPiece) {
      codes.rows = std::min(kPiece, before.size() - first);
      for (size_t i = 0; i < codes.rows; ++i) {
        std::copy_n(queries_.codes.row(before[first + i]), dim_, codes.row(i));
      }
      const Matches found =
          tuned_.quantizer().nlist() == 0
              ? search_exact(view, codes, kNearest, options)
              : search_lists(view, InvertedLists(tuned_.lists()), tuned_.quantizer().packed(),
                             kLists, codes, kNearest, options);
      for (size_t i = 0; i < codes.rows; ++i) {
        add_forces(before[first + i], found.ids.row(i), found.distances.row(i));
      }
    }
    firsts_.push_back(forces_.size());
    on_row_.resize(forces_.size());
    std::iota(on_row_.begin(), on_row_.end(), size_t{0});
    std::ranges::stable_sort(on_row_, {}, [&](size_t f) { return forces_[f].rank; });
    weights_.resize(forces_.size());
  }

  void add_forces(uint32_t q, const int64_t* ranks, const int32_t* distances) {
    const auto query = static_cast<uint32_t>(contested_.size());
    const int64_t limit = own_distance(q) + kReach * temperature_;
    for (size_t j = 0; j < kNearest && ranks[j] >= 0; ++j) {
      const auto rank = static_cast<uint32_t>(ranks[j]);
      const int64_t owner = tuned_.id(tuned_.owner(rows_[rank]));
      if (distances[j] > limit || owner == queries_.landmarks[q]) continue;
      if (contested_.size() == query) {
        contested_.push_back(q);
        firsts_.push_back(forces_.size());
        forces_.push_back({query, own_[q]});
      }
      forces_.push_back({query, rank});
    }
  }

  // Returns the squared distance of a query to a prototype, in units of 4^-kFraction.
  uint32_t distance(const int8_t* code, const int16_t* prototype) const {
    uint32_t sum = 0;
    for (size_t d = 0; d < dim_; ++d) {
      const int difference = code[d] * (1 << kFraction) - prototype[d];
      sum += static_cast<uint32_t>(difference * difference);
    }
    return sum;
  }

  // Returns the squared distance of a query to its own prototype as if it had not been added: with
  // s = w / (n - w) the difference is query - prototype + s (query - mean).
  int64_t own_distance(size_t q) const {
    const int16_t* prototype = &numbers_[own_[q] * dim_];
    const int8_t* code = queries_.codes.row(q);
    const int8_t* mean = means_.row(own_[q]);
    int32_t product = 0;
    for (size_t d = 0; d < dim_; ++d) {
      product += (code[d] * (1 << kFraction) - prototype[d]) * (code[d] - mean[d]);
    }
    const double s = static_cast<double>(queries_.weights[q]) / static_cast<double>(rest(q));
    const double now = distance(code, prototype) / double{1 << 2 * kFraction};
    const double both = product / double{1 << kFraction};
    const double before = squared_distance(code, mean, dim_);
    return static_cast<int64_t>(now + 2 * s * both + s * s * before);
  }

  // Makes one pass over all queries, then moves all prototypes.
  void move() {
    parallel_for(threads_, contested_.size(), 64, [&](size_t begin, size_t end) {
      for (size_t query = begin; query < end; ++query) weigh(query);
    });
    parallel_for(threads_, rows_.size(), 64, [&](size_t begin, size_t end) {
      std::vector<int64_t> sums(dim_);
      std::vector<int32_t> part(dim_);
      for (size_t rank = begin; rank < end; ++rank) {
        const auto on_row =
            std::ranges::equal_range(on_row_, rank, {}, [&](size_t f) { return forces_[f].rank; });
        if (on_row.empty()) continue;
        std::ranges::fill(sums, 0);
        std::ranges::fill(part, 0);
        int64_t total = 0, in_part = 0;
        const auto flush = [&] {
          for (size_t d = 0; d < dim_; ++d) sums[d] += std::exchange(part[d], 0);
          in_part = 0;
        };
        for (const size_t f : on_row) {
          const int32_t weight = weights_[f];
          if (weight == 0) continue;
          total += weight;
          in_part += std::abs(weight);
          if (in_part > kPartWeight) {
            flush();
            in_part = std::abs(weight);
          }
          const int8_t* code = queries_.codes.row(contested_[forces_[f].query]);
          for (size_t d = 0; d < dim_; ++d) part[d] += weight * code[d];
        }
        flush();
        int16_t* prototype = &numbers_[rank * dim_];
        const double step = kStep / (static_cast<double>(counts_[rank] + 2) * kUnit);
        for (size_t d = 0; d < dim_; ++d) {
          const int64_t sum = sums[d] * (1 << kFraction) - total * prototype[d];
          const double moved = prototype[d] + step * static_cast<double>(sum);
          const double limit = 127 << kFraction;
          prototype[d] = static_cast<int16_t>(std::floor(std::clamp(moved, -limit, limit) + 0.5));
        }
      }
    });
  }

  // Computes the forces of a query.
  void weigh(size_t query) {
    const size_t q = contested_[query], first = firsts_[query], end = firsts_[query + 1];
    std::array<int64_t, kNearest + 1> distances;
    distances[0] = own_distance(q);
    const int8_t* code = queries_.codes.row(q);
    for (size_t f = first + 1; f < end; ++f) {
      distances[f - first] = distance(code, &numbers_[forces_[f].rank * dim_]) >> (2 * kFraction);
    }
    const size_t n = end - first;
    const int64_t nearest = *std::min_element(distances.begin(), distances.begin() + n);
    const std::vector<uint32_t>& table = exponentials();
    std::array<uint64_t, kNearest + 1> terms;
    uint64_t sum = 0;
    for (size_t i = 0; i < n; ++i) {
      const auto at = static_cast<uint64_t>((distances[i] - nearest) * 64 / temperature_);
      terms[i] = at < table.size() ? table[at] : 0;
      sum += terms[i];
    }
    int32_t others = 0;
    for (size_t i = 1; i < n; ++i) {
      const auto probability = static_cast<int32_t>(terms[i] * kUnit / sum);
      weights_[first + i] = -probability * queries_.weights[q];
      others += probability;
    }
    weights_[first] = others * queries_.weights[q];
  }

  PrototypeStore tuned_;
  bool indexed_;
  const TuningQueries& queries_;
  int threads_;
  size_t dim_;

  // By rank.
  std::vector<Row> rows_;
  Matrix<int8_t> means_;
  std::vector<int16_t> numbers_;      // prototypes, with kFraction bits behind the point
  std::vector<uint32_t> counts_;      // observations
  std::vector<int64_t> rank_of_row_;  // -1 for padding

  std::vector<uint32_t> own_;  // the rank of each query's own prototype, or UINT32_MAX
  int64_t temperature_ = 1;

  std::vector<uint32_t> contested_;  // queries that have rivals
  std::vector<size_t> firsts_;       // the first force of each, and the end
  std::vector<Force> forces_;        // of each query on its own prototype, then on its rivals
  std::vector<int32_t> weights_;     // of each force, in kUnit
  std::vector<size_t> on_row_;       // forces by the rank that they are on, then by query
};

}  // namespace

TuningQueries::TuningQueries(const PrototypeStore& map, size_t dim)
    : codes(map.prototype_count(), dim) {
  std::vector<int8_t> code(map.dim());
  map.each_row([&](Row row) {
    map.rounded(row, code.data());
    std::copy_n(code.data(), dim, codes.row(landmarks.size()));
    landmarks.push_back(map.id(map.owner(row)));
    weights.push_back(static_cast<uint8_t>(map.count(row)));
  });
}

PrototypeStore tune_prototypes(const PrototypeStore& store, const TuningQueries& queries,
                               int threads) {
  return Tuner(store, queries, threads).run();
}

}  // namespace protomark
