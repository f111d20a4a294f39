// Compiled without contraction of products and sums (core/CMakeLists.txt).
#include "map/sealed_store.h"

#include <numeric>
#include <utility>

namespace protomark {
namespace {

// Comparing all pairs of more rows would take seconds to minutes. A sealed map keeps far fewer per
// landmark.
constexpr std::size_t kMaxCompared = 2048;

// The prototypes that remain, each with the later one of least merge cost as partner: the generic
// algorithm of Muellner 2011, "Modern hierarchical, agglomerative clustering algorithms".
class Clusters {
 public:
  // Adds to `merges` those that bring the number of rows down to kMaxCompared.
  Clusters(std::span<const std::int16_t> sums, std::span<const std::uint8_t> counts,
           std::size_t dim, std::vector<AppearanceMerge>& merges)
      : dim_(dim),
        sums_(sums.begin(), sums.end()),
        counts_(counts.begin(), counts.end()),
        remaining_(counts.size()),
        partner_(counts.size(), 0),
        cost_(counts.size(), 0) {
    std::iota(remaining_.begin(), remaining_.end(), std::size_t{0});
    while (remaining_.size() > kMaxCompared) halve(merges);
    for (std::size_t at = 0; at + 1 < remaining_.size(); ++at) find_partner(at);
  }

  std::size_t size() const { return remaining_.size(); }

  // Merges the pair of least cost.
  AppearanceMerge merge_best() {
    std::size_t best = 0;
    for (std::size_t at = 1; at + 1 < remaining_.size(); ++at) {
      if (cost_[remaining_[at]] < cost_[remaining_[best]]) best = at;
    }
    const std::size_t into = remaining_[best], source = partner_[into];
    const AppearanceMerge result{cost_[into], static_cast<std::uint16_t>(into),
                                 static_cast<std::uint16_t>(source)};
    merge(into, source);
    std::erase(remaining_, source);
    for (std::size_t at = 0; at + 1 < remaining_.size() && remaining_[at] < source; ++at) {
      const std::size_t row = remaining_[at];
      if (at == best || partner_[row] == into || partner_[row] == source) {
        find_partner(at);
      } else if (at < best) {
        offer(row, into);
      }
    }
    return result;
  }

 private:
  void merge(std::size_t into, std::size_t source) {
    for (std::size_t d = 0; d < dim_; ++d) sums_[into * dim_ + d] += sums_[source * dim_ + d];
    counts_[into] += counts_[source];
  }

  // Merges each second row into the one before it.
  void halve(std::vector<AppearanceMerge>& merges) {
    std::vector<std::size_t> halved;
    for (std::size_t at = 0; at < remaining_.size(); at += 2) {
      halved.push_back(remaining_[at]);
      if (at + 1 == remaining_.size()) break;
      merge(remaining_[at], remaining_[at + 1]);
      merges.push_back({0.0, static_cast<std::uint16_t>(remaining_[at]),
                        static_cast<std::uint16_t>(remaining_[at + 1])});
    }
    remaining_ = std::move(halved);
  }

  void find_partner(std::size_t at) {
    const std::size_t row = remaining_[at];
    partner_[row] = remaining_[at + 1];
    cost_[row] = cost(row, partner_[row]);
    for (std::size_t other = at + 2; other < remaining_.size(); ++other) {
      offer(row, remaining_[other]);
    }
  }

  void offer(std::size_t row, std::size_t other) {
    const double c = cost(row, other);
    if (c < cost_[row] || (c == cost_[row] && other < partner_[row])) {
      cost_[row] = c;
      partner_[row] = other;
    }
  }

  // |a/n - b/m|^2 n m / (n + m) = |m a - n b|^2 / (n m (n + m)). All but the division is exact
  // below 2^53, which no real landmark exceeds.
  double cost(std::size_t i, std::size_t j) const {
    const double *a = &sums_[i * dim_], *b = &sums_[j * dim_];
    const double n = counts_[i], m = counts_[j];
    // Four sums, so that a compiler may use vectors without changing the order of additions.
    double part[4] = {};
    std::size_t d = 0;
    for (; d + 4 <= dim_; d += 4) {
      for (std::size_t k = 0; k < 4; ++k) {
        const double difference = m * a[d + k] - n * b[d + k];
        part[k] += difference * difference;
      }
    }
    for (; d < dim_; ++d) {
      const double difference = m * a[d] - n * b[d];
      part[d % 4] += difference * difference;
    }
    return ((part[0] + part[1]) + (part[2] + part[3])) / (n * m * (n + m));
  }

  std::size_t dim_;
  std::vector<double> sums_;  // whole numbers
  std::vector<double> counts_;
  std::vector<std::size_t> remaining_;  // ascending
  std::vector<std::size_t> partner_;    // of all but the last that remains
  std::vector<double> cost_;            // of merging with the partner
};

}  // namespace

std::vector<AppearanceMerge> appearance_merges(std::span<const std::int16_t> sums,
                                               std::span<const std::uint8_t> counts,
                                               std::size_t dim) {
  std::vector<AppearanceMerge> result;
  Clusters clusters(sums, counts, dim, result);
  while (clusters.size() > 1) result.push_back(clusters.merge_best());
  return result;
}

}  // namespace protomark
