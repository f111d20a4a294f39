#include "search/scan.h"

#include <algorithm>
#include <cstring>

namespace protomark {
namespace {

std::int32_t squared_norm(const std::uint8_t* code, std::size_t dim) {
  std::int32_t sum = 0;
  for (std::size_t d = 0; d < dim; ++d) sum += (code[d] - 128) * (code[d] - 128);
  return sum;
}

}  // namespace

static_assert(kPackedRows == kernels::kCodeRows);

std::vector<CodeVector> pack_codes(Codes codes) {
  std::vector<CodeVector> result(packed_size(codes.rows, codes.columns) / sizeof(CodeVector));
  auto* to = reinterpret_cast<std::int8_t*>(result.data());
  for (std::size_t row = 0; row < codes.rows; ++row) {
    for (std::size_t d = 0; d < codes.columns; ++d) {
      to[packed_index(row, d, codes.columns)] = codes.row(row)[d];
    }
  }
  return result;
}

BlockReader::BlockReader(const PackedPrototypes& prototypes)
    : data_(static_cast<const std::uint8_t*>(prototypes.data)),
      dim_(prototypes.dim),
      scale_(prototypes.scale),
      block_bytes_(scale_ == 0 ? packed_size(kPackedRows, dim_) : packed4_size(kPackedRows, dim_)),
      code_bytes_(packed_size(kPackedRows, dim_)) {}

const std::int8_t* BlockReader::read(std::size_t first_block, std::size_t n) {
  const std::uint8_t* stored = data_ + first_block * block_bytes_;
  if (scale_ == 0) return reinterpret_cast<const std::int8_t*>(stored);
  std::int8_t* codes = room(n);
  copy(first_block, n, codes);
  return codes;
}

const std::int8_t* BlockReader::read(std::span<const std::uint32_t> blocks) {
  bool consecutive = true;
  for (std::size_t i = 1; i < blocks.size(); ++i) {
    consecutive = consecutive && blocks[i] == blocks[i - 1] + 1;
  }
  if (consecutive) return read(blocks[0], blocks.size());
  std::int8_t* codes = room(blocks.size());
  for (std::size_t i = 0; i < blocks.size(); ++i) copy(blocks[i], 1, codes + i * code_bytes_);
  return codes;
}

void BlockReader::copy(std::size_t first_block, std::size_t n, std::int8_t* codes) const {
  const std::uint8_t* stored = data_ + first_block * block_bytes_;
  if (scale_ == 0) {
    std::memcpy(codes, stored, n * block_bytes_);
  } else {
    kernels::active().code_unpack4(stored, n, dim_, scale_, codes);
  }
}

std::int8_t* BlockReader::room(std::size_t blocks) {
  room_.resize(std::max(room_.size(), blocks * code_bytes_ / sizeof(CodeVector)));
  return reinterpret_cast<std::int8_t*>(room_.data());
}

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

Neighbours PreparedCodes::neighbours(std::size_t k, const SearchOptions& options) const {
  std::vector<std::int32_t> limits(queries(), CodeScan::kNoLimit);
  // The ratio test needs the second nearest at any distance.
  if (options.max_distance && !options.ratio) {
    for (std::size_t q = 0; q < limits.size(); ++q) {
      limits[q] = std::min(limits[q], *options.max_distance - norms_[q]);
    }
  }
  return {options.ratio ? std::max<std::size_t>(k, 2) : k, limits};
}

CodeScan::CodeScan(const PreparedCodes& queries, Range range)
    : all_(queries),
      range_(range),
      codes_(queries[range.begin]),
      n_(range.size()),
      prefix_(queries.dim()),
      rest_norms_(range.size(), 0) {}

void CodeScan::select(std::span<const std::uint32_t> queries) {
  const std::size_t dim = all_.dim();
  selected_.resize(queries.size() * dim);
  for (std::size_t i = 0; i < queries.size(); ++i) {
    std::copy_n(all_[range_.begin + queries[i]], dim, &selected_[i * dim]);
  }
  codes_ = selected_.data();
  n_ = queries.size();
}

std::size_t CodeScan::chunk_rows() const {
  const auto bytes =
      std::clamp<std::size_t>(256 * n_, n_ <= kernels::kFewQueries ? 16384 : 8192, 65536);
  return std::max<std::size_t>(bytes / all_.dim() / kPackedRows, 1) * kPackedRows;
}

void CodeScan::choose_prefix(std::size_t met) {
  // Few queries wait for memory, which is read as a whole. The more rows were met, the nearer are
  // the neighbours, and the fewer dimensions suffice.
  constexpr std::size_t kManyRows = std::size_t{1} << 18;
  if (n_ <= kernels::kFewQueries) return;
  const std::size_t eighths = met < kManyRows ? 6 : 5;
  const std::size_t prefix = (all_.dim() * eighths / 8 + 3) / 4 * 4;
  if (prefix == prefix_) return;
  prefix_ = prefix;
  for (std::size_t q = 0; q < range_.size(); ++q) {
    rest_norms_[q] = squared_norm(all_[range_.begin + q] + prefix, all_.dim() - prefix);
  }
}

kernels::PackedCodes CodeScan::prepare(const std::int8_t* packed, std::size_t rows) {
  const std::size_t dim = all_.dim(), blocks = (rows + kPackedRows - 1) / kPackedRows;
  if (n_ <= kernels::kFewQueries) return {packed, nullptr, nullptr, blocks, dim, prefix_};
  biases_.resize(std::max(biases_.size(), blocks * kPackedRows));
  prefix_biases_.resize(biases_.size());
  kernels::active().code_biases(packed, blocks, dim, prefix_, biases_.data(),
                                prefix_biases_.data());
  return {packed, biases_.data(), prefix_biases_.data(), blocks, dim, prefix_};
}

void PrototypeScan::scan(Range rows) {
  const std::size_t chunk_rows = scan_.chunk_rows();
  for (std::size_t row = rows.begin; row < rows.end; row += chunk_rows) {
    const std::size_t n = std::min(chunk_rows, rows.end - row);
    scan_.choose_prefix(row - rows.begin);
    chunk_ = {row, row + n};
    of_chunk_.clear();
    scan_.compare(
        blocks_.read(row / kPackedRows, (n + kPackedRows - 1) / kPackedRows), n,
        [&](std::size_t q) { return nearest_.limit(q); },
        [&](std::size_t q, std::int32_t distance, std::size_t i) {
          offer(nearest_[q], distance, row_at(row + i));
        });
  }
}

void PrototypeScan::scan(std::span<const std::uint32_t> queries,
                         std::span<const std::uint32_t> blocks, std::size_t rows) {
  constexpr std::size_t kChunk = 32;
  scan_.select(queries);
  for (std::size_t first = 0; first < blocks.size(); first += kChunk) {
    const auto chunk = blocks.subspan(first, std::min(kChunk, blocks.size() - first));
    const std::size_t n = std::min(chunk.size() * kPackedRows, rows - first * kPackedRows);
    scan_.compare(
        blocks_.read(chunk), n, [&](std::size_t i) { return nearest_.limit(queries[i]); },
        [&](std::size_t i, std::int32_t distance, std::size_t at) {
          const std::size_t row = chunk[at / kPackedRows] * kPackedRows + at % kPackedRows;
          offer(nearest_[queries[i]], distance, row_at(row));
        });
  }
}

void PrototypeScan::count_chunk() {
  const std::uint8_t* counts = landmarks_.row_counts;
  while (counted_ + counts[landmark_.value] <= chunk_.begin) counted_ += counts[landmark_.value++];
  LandmarkIndex landmark = landmark_;
  std::size_t end = counted_ + counts[landmark.value];
  for (std::size_t row = chunk_.begin; row < chunk_.end; ++row) {
    if (row == end) end += counts[++landmark.value];
    of_chunk_.push_back(landmark);
  }
}

void scan_all(const PackedPrototypes& prototypes, const PreparedCodes& queries, int threads,
              Neighbours& nearest) {
  run_search(threads, Division::of_rows(threads, queries.queries(), prototypes.rows),
             prototypes.rows, nearest, [&](Range some, Range rows, Neighbours& part) {
               PrototypeScan(prototypes, queries, some, part).scan(rows);
             });
}

Matches search_exact(const PackedPrototypes& prototypes, Codes queries, std::size_t k,
                     const SearchOptions& options) {
  Matches matches = check_search(prototypes.dim, queries, k, options);
  const PreparedCodes prepared(queries);
  Neighbours nearest = prepared.neighbours(k, options);
  scan_all(prototypes, prepared, options.threads, nearest);
  write_answer(nearest, prepared.norms(), options, 0, matches);
  return matches;
}

Matches check_search(std::size_t dim, Codes queries, std::size_t k, const SearchOptions& options) {
  if (queries.columns != dim) {
    invalid("queries have ", queries.columns, " dimensions, prototypes ", dim);
  }
  if (options.ratio && !(*options.ratio > 0 && *options.ratio <= 1)) {
    invalid("ratio must be above 0 and at most 1");
  }
  return room_for_answer(queries.rows, k, options.max_distance);
}

}  // namespace protomark
