#include "search/code_scan.h"

#include <algorithm>

namespace protomark {
namespace {

std::int32_t squared_norm(const std::uint8_t* code, std::size_t dim) {
  std::int32_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += (code[d] - 128) * (code[d] - 128);
  return sum;
}

}  // namespace

PreparedCodes::PreparedCodes(Codes codes)
    : dim_(packed_dim(codes.columns)), codes_(codes.rows * dim_, 128) {
  norms_.reserve(codes.rows);
  for (std::size_t q = 0; q < codes.rows; ++q) {
    for (std::size_t d = 0; d < codes.columns; ++d) {
      codes_[q * dim_ + d] = static_cast<std::uint8_t>(codes.row(q)[d] + 128);
    }
    norms_.push_back(squared_norm((*this)[q], dim_));
  }
}

Neighbours PreparedCodes::places(std::size_t k, const SearchOptions& options) const {
  std::vector<std::int32_t> limits(queries(), CodeScan::kNoLimit);
  // With the ratio test, the second nearest counts at any distance.
  if (options.max_distance && !options.ratio) {
    for (std::size_t q = 0; q < limits.size(); ++q) {
      limits[q] = std::min(limits[q], *options.max_distance - norms_[q]);
    }
  }
  return {options.ratio ? std::max<std::size_t>(k, 2) : k, limits};
}

CodeScan::CodeScan(const PreparedCodes& queries, Range range)
    : all_(queries), range_(range), prefix_(queries.dim()), rest_norms_(range.size(), 0) {}

std::size_t CodeScan::chunk_rows() const {
  const std::size_t n = range_.size();
  const auto bytes =
      std::clamp<std::size_t>(256 * n, n <= kernels::kFewQueries ? 16384 : 8192, 65536);
  return std::max<std::size_t>(bytes / all_.dim() / kPackedRows, 1) * kPackedRows;
}

void CodeScan::choose_prefix(std::size_t met) {
  // Few queries wait for memory, which is read whole. The more rows were met, the nearer are the
  // neighbours, and the fewer dimensions tell.
  constexpr std::size_t kManyRows = std::size_t{1} << 18;
  if (range_.size() <= kernels::kFewQueries) return;
  const std::size_t eighths = met < kManyRows ? 6 : 5;
  const std::size_t prefix = (all_.dim() * eighths / 8 + 3) / 4 * 4;
  if (prefix == prefix_) return;
  prefix_ = prefix;
  for (std::size_t q = 0; q < range_.size(); ++q) {
    rest_norms_[q] = squared_norm(all_[range_.begin + q] + prefix, all_.dim() - prefix);
  }
}

void CodeScan::gather(std::span<const std::uint32_t> queries) {
  const std::size_t dim = all_.dim();
  gathered_.resize(queries.size() * dim);
  for (std::size_t i = 0; i < queries.size(); ++i) {
    std::copy_n(all_[range_.begin + queries[i]], dim, &gathered_[i * dim]);
  }
}

kernels::PackedCodes CodeScan::prepare(const std::int8_t* packed, std::size_t rows, std::size_t n) {
  const std::size_t dim = all_.dim(), blocks = (rows + kPackedRows - 1) / kPackedRows;
  if (n <= kernels::kFewQueries) return {packed, nullptr, nullptr, blocks, dim, prefix_};
  biases_.resize(std::max(biases_.size(), blocks * kPackedRows));
  prefix_biases_.resize(biases_.size());
  kernels::active().code_biases(packed, blocks, dim, prefix_, biases_.data(),
                                prefix_biases_.data());
  return {packed, biases_.data(), prefix_biases_.data(), blocks, dim, prefix_};
}

}  // namespace protomark
