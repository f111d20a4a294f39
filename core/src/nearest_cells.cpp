#include "nearest_cells.h"

#include <algorithm>

#include "kernels/kernels.h"
#include "parallel.h"

namespace protomark {
namespace {

// One block in so many tells how near the nearest centroids are.
constexpr std::size_t kSampleStep = 8;

// All centroids against one query after the other. For one thread.
class Ranking {
 public:
  explicit Ranking(const PackedPrototypes& centroids)
      : centroids_(centroids),
        dim_(packed_dim(centroids.dim)),
        blocks_((centroids.rows + kPackedRows - 1) / kPackedRows),
        query_(dim_, 128),
        offsets_(blocks_ * kPackedRows),
        rows_(offsets_.size()),
        distances_(offsets_.size()) {
    kernels::active().code_offsets(centroids.data, blocks_, dim_, offsets_.data());
  }

  void nearest(const std::int8_t* query, std::size_t probes, std::uint32_t* to) {
    for (std::size_t d = 0; d < centroids_.dim; ++d) {
      query_[d] = static_cast<std::uint8_t>(query[d] + 128);
    }
    scan(0, blocks_, limit_for(probes));
    if (found_.size() < probes) {
      found_.clear();
      scan(0, blocks_, INT32_MAX);
    }
    const auto end = found_.begin() + static_cast<std::ptrdiff_t>(probes);
    if (end != found_.end()) std::nth_element(found_.begin(), end - 1, found_.end());
    std::iter_swap(found_.begin(), std::min_element(found_.begin(), end));
    for (std::size_t i = 0; i < probes; ++i) to[i] = static_cast<std::uint32_t>(found_[i]);
    found_.clear();
  }

 private:
  // A distance that is likely to leave some more than `probes` centroids.
  std::int32_t limit_for(std::size_t probes) {
    for (std::size_t block = 0; block < blocks_; block += kSampleStep) scan(block, 1, INT32_MAX);
    const std::size_t rank = probes * 3 / 2 / kSampleStep + 4;
    std::int32_t limit = INT32_MAX;
    if (rank < found_.size()) {
      const auto at = found_.begin() + static_cast<std::ptrdiff_t>(rank);
      std::nth_element(found_.begin(), at, found_.end());
      limit = static_cast<std::int32_t>(*at >> 32);
    }
    found_.clear();
    return limit;
  }

  // Appends centroids within the limit: distances above, numbers below.
  void scan(std::size_t block, std::size_t blocks, std::int32_t limit) {
    const std::size_t n = kernels::active().code_scan(
        query_.data(), centroids_.data + block * kPackedRows * dim_, blocks, dim_,
        &offsets_[block * kPackedRows], limit, {rows_.data(), distances_.data()});
    for (std::size_t i = 0; i < n; ++i) {
      const std::size_t row = block * kPackedRows + rows_[i];
      if (row < centroids_.rows) {
        found_.push_back(std::int64_t{distances_[i]} * (std::int64_t{1} << 32) +
                         static_cast<std::int64_t>(row));
      }
    }
  }

  PackedPrototypes centroids_;
  std::size_t dim_;
  std::size_t blocks_;
  std::vector<std::uint8_t> query_;
  std::vector<std::int32_t> offsets_;
  std::vector<std::uint32_t> rows_;
  std::vector<std::int32_t> distances_;
  std::vector<std::int64_t> found_;
};

}  // namespace

std::vector<std::uint32_t> nearest_cells(const PackedPrototypes& centroids, Codes queries,
                                         std::size_t probes, int threads) {
  std::vector<std::uint32_t> result(queries.rows * probes);
  parallel_for(threads, queries.rows, 16, [&](std::size_t first, std::size_t last) {
    Ranking ranking(centroids);
    for (std::size_t q = first; q < last; ++q) {
      ranking.nearest(queries.row(q), probes, &result[q * probes]);
    }
  });
  return result;
}

}  // namespace protomark
