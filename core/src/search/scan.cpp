#include "search/scan.h"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace protomark {
namespace {

static_assert(kPackedRows == kernels::kCodeRows);

// Squared distances reach 256 * 254^2 < 2^24, which float holds exactly; this is beyond all.
constexpr std::int32_t kNoLimit = 1 << 25;

// Rows that are compared with all queries at a time. Many queries come back to them from the L2
// cache; for few, rows should come from memory while the last ones are compared.
std::size_t rows_of_chunk(std::size_t queries, std::size_t dim) {
  const auto bytes =
      std::clamp<std::size_t>(256 * queries, queries <= kernels::kFewQueries ? 16384 : 8192, 65536);
  return std::max<std::size_t>(bytes / dim / kPackedRows, 1) * kPackedRows;
}

std::int32_t squared_norm(const std::int8_t* code, std::size_t dim) {
  std::int32_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += code[d] * code[d];
  return sum;
}

// Whether a squared distance is within the limits; doubles hold all values exactly enough that the
// answer is the same on every machine.
bool within(std::int32_t squared, float max_distance) {
  return static_cast<double>(squared) <= static_cast<double>(max_distance) * max_distance;
}

bool distinct(std::int32_t nearest, std::int32_t second, float ratio) {
  return static_cast<double>(nearest) < static_cast<double>(ratio) * ratio * second;
}

}  // namespace

void check_search(std::size_t dim, Codes queries, const SearchOptions& options,
                  const MatrixView<std::int64_t>& ids, const MatrixView<float>& distances) {
  if (queries.columns != dim) {
    throw std::invalid_argument("queries have " + std::to_string(queries.columns) +
                                " dimensions, prototypes " + std::to_string(dim));
  }
  if (dim == 0 || dim > 256) {
    throw std::invalid_argument("a code has 1 to 256 dimensions, not " + std::to_string(dim));
  }
  if (ids.columns == 0) throw std::invalid_argument("k must be at least 1");
  if (ids.rows != queries.rows || distances.rows != queries.rows ||
      ids.columns != distances.columns) {
    throw std::invalid_argument("ids and distances must be queries x k");
  }
  if (options.max_distance && !(*options.max_distance >= 0)) {
    throw std::invalid_argument("max_distance must not be negative");
  }
  if (options.ratio && !(*options.ratio > 0 && *options.ratio <= 1)) {
    throw std::invalid_argument("ratio must be above 0 and at most 1");
  }
}

CodeScan::CodeScan(Codes queries, std::size_t k, const SearchOptions& options)
    : codes_(queries),
      options_(options),
      dim_(packed_dim(queries.columns)),
      kept_(options.ratio ? std::max<std::size_t>(k, 2) : k),
      unsigned_codes_(queries.rows * dim_, 128),
      best_ids_(queries.rows * kept_),
      best_distances_(queries.rows * kept_),
      head_(dim_),
      tails_(queries.rows, 0),
      chunk_rows_(rows_of_chunk(queries.rows, dim_)),
      biases_(chunk_rows_),
      head_biases_(chunk_rows_),
      hits_(kernels::kHitRoom) {
  best_.reserve(queries.rows);
  for (std::size_t q = 0; q < queries.rows; ++q) {
    const std::int8_t* code = queries.row(q);
    for (std::size_t d = 0; d < queries.columns; ++d) {
      unsigned_codes_[q * dim_ + d] = static_cast<std::uint8_t>(code[d] + 128);
    }
    best_.emplace_back(&best_ids_[q * kept_], &best_distances_[q * kept_], kept_, kNoLimit);
  }
}

void CodeScan::look_at_heads(std::size_t met) {
  // Few queries wait for memory, which is read whole. The more rows were met, the nearer are the
  // neighbours, and the fewer dimensions tell.
  constexpr std::size_t kManyRows = std::size_t{1} << 18;
  if (queries() <= kernels::kFewQueries) return;
  const std::size_t eighths = met < kManyRows ? 6 : 5;
  const std::size_t head = (dim_ * eighths / 8 + 3) / 4 * 4;
  if (head == head_) return;
  head_ = head;
  const std::size_t compared = std::min(head, codes_.columns);
  for (std::size_t q = 0; q < codes_.rows; ++q) {
    tails_[q] = squared_norm(codes_.row(q) + compared, codes_.columns - compared);
  }
}

void CodeScan::gather(std::span<const std::uint32_t> queries) {
  gathered_.resize(queries.size() * dim_);
  for (std::size_t i = 0; i < queries.size(); ++i) {
    std::copy_n(&unsigned_codes_[queries[i] * dim_], dim_, &gathered_[i * dim_]);
  }
}

void CodeScan::start_chunk(const std::int8_t* packed, std::size_t rows, std::size_t queries) {
  packed_ = packed;
  blocks_ = (rows + kPackedRows - 1) / kPackedRows;
  biased_ = queries > kernels::kFewQueries;
  if (!biased_) return;
  kernels::active().code_biases(packed_, blocks_, dim_, head_, biases_.data(), head_biases_.data());
}

std::size_t CodeScan::scan_chunk(std::span<const std::uint32_t> group, std::size_t first,
                                 std::size_t* block) {
  std::int32_t tails[kernels::kScanQueries];
  for (std::size_t i = 0; i < group.size(); ++i) {
    limits_[i] = best_[group[i]].limit();
    tails[i] = tails_[group[i]];
  }
  return kernels::active().code_scan(
      {&gathered_[first * dim_], limits_.data(), tails, group.size(), &put_off_},
      {packed_, biased_ ? biases_.data() : nullptr, head_biases_.data(), blocks_, dim_, head_},
      block, hits_.data());
}

void CodeScan::merge(const CodeScan& other) {
  for (std::size_t i = 0; i < best_ids_.size(); ++i) {
    if (other.best_ids_[i] < 0) continue;
    best_[i / kept_].offer_distinct(other.best_distances_[i], other.best_ids_[i]);
  }
}

void CodeScan::finish(MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  const std::size_t k = ids.columns;
  for (std::size_t q = 0; q < codes_.rows; ++q) {
    const std::int32_t norm = squared_norm(codes_.row(q), codes_.columns);
    const std::int64_t* found_ids = &best_ids_[q * kept_];
    const std::int32_t* found = &best_distances_[q * kept_];
    const bool keep = !options_.ratio || kept_ < 2 || found_ids[1] < 0 ||
                      distinct(found[0] + norm, found[1] + norm, *options_.ratio);
    for (std::size_t j = 0; j < k; ++j) {
      const bool valid =
          keep && found_ids[j] >= 0 &&
          (!options_.max_distance || within(found[j] + norm, *options_.max_distance));
      ids.row(q)[j] = valid ? found_ids[j] : -1;
      distances.row(q)[j] = valid ? std::sqrt(static_cast<float>(found[j] + norm))
                                  : std::numeric_limits<float>::infinity();
    }
  }
}

}  // namespace protomark
