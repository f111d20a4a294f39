// Compiled without contraction of products and sums (core/CMakeLists.txt).
#include "map/prune.h"

#include <numeric>
#include <utility>

namespace protomark {
namespace {

// Comparing all pairs of more rows would take seconds and, in a file made to that end, minutes. A
// sealed map keeps far fewer of any landmark.
constexpr std::size_t kMostCompared = 2048;

// Prototypes that are left, and for each the cheapest partner after it. (Muellner 2011, "Modern
// hierarchical, agglomerative clustering algorithms", calls this the generic algorithm.)
class Clusters {
 public:
  // Joins made on the way to a number of rows that can be compared go to `joins`.
  Clusters(std::span<const std::int16_t> sums, std::span<const std::uint8_t> counts,
           std::size_t dim, std::vector<Join>& joins)
      : dim_(dim),
        sums_(sums.begin(), sums.end()),
        counts_(counts.begin(), counts.end()),
        left_(counts.size()),
        partner_(counts.size(), 0),
        cost_(counts.size(), 0) {
    std::iota(left_.begin(), left_.end(), std::size_t{0});
    while (left_.size() > kMostCompared) halve(joins);
    for (std::size_t at = 0; at + 1 < left_.size(); ++at) find_partner(at);
  }

  std::size_t size() const { return left_.size(); }

  // Joins the cheapest pair.
  Join join() {
    std::size_t best = 0;
    for (std::size_t at = 1; at + 1 < left_.size(); ++at) {
      if (cost_[left_[at]] < cost_[left_[best]]) best = at;
    }
    const std::size_t into = left_[best], from = partner_[into];
    const Join result{cost_[into], static_cast<std::uint16_t>(into),
                      static_cast<std::uint16_t>(from)};
    merge(into, from);
    std::erase(left_, from);
    for (std::size_t at = 0; at + 1 < left_.size() && left_[at] < from; ++at) {
      const std::size_t row = left_[at];
      if (at == best || partner_[row] == into || partner_[row] == from) {
        find_partner(at);
      } else if (at < best) {
        offer(row, into);
      }
    }
    return result;
  }

 private:
  void merge(std::size_t into, std::size_t from) {
    for (std::size_t d = 0; d < dim_; ++d) sums_[into * dim_ + d] += sums_[from * dim_ + d];
    counts_[into] += counts_[from];
  }

  // Each second row goes into the one before it.
  void halve(std::vector<Join>& joins) {
    std::vector<std::size_t> left;
    for (std::size_t at = 0; at < left_.size(); at += 2) {
      left.push_back(left_[at]);
      if (at + 1 == left_.size()) break;
      merge(left_[at], left_[at + 1]);
      joins.push_back(
          {0.0, static_cast<std::uint16_t>(left_[at]), static_cast<std::uint16_t>(left_[at + 1])});
    }
    left_ = std::move(left);
  }

  void find_partner(std::size_t at) {
    const std::size_t row = left_[at];
    partner_[row] = left_[at + 1];
    cost_[row] = cost(row, partner_[row]);
    for (std::size_t other = at + 2; other < left_.size(); ++other) offer(row, left_[other]);
  }

  void offer(std::size_t row, std::size_t other) {
    const double c = cost(row, other);
    if (c < cost_[row] || (c == cost_[row] && other < partner_[row])) {
      cost_[row] = c;
      partner_[row] = other;
    }
  }

  // |a/n - b/m|^2 n m / (n + m) = |m a - n b|^2 / (n m (n + m)). Below 2^53, beyond which no real
  // landmark goes, everything but the division is an exact integer.
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
  std::vector<double> sums_;  // integers
  std::vector<double> counts_;
  std::vector<std::size_t> left_;     // ascending
  std::vector<std::size_t> partner_;  // of all but the last one left
  std::vector<double> cost_;          // of joining it
};

}  // namespace

std::vector<Join> ward_joins(std::span<const std::int16_t> sums,
                             std::span<const std::uint8_t> counts, std::size_t dim) {
  std::vector<Join> result;
  Clusters clusters(sums, counts, dim, result);
  while (clusters.size() > 1) result.push_back(clusters.join());
  return result;
}

}  // namespace protomark
