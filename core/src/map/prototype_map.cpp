#include "protomark/prototypes.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <mutex>
#include <stdexcept>
#include <string>
#include <unordered_map>

#include "base/id_set.h"
#include "base/parallel.h"
#include "file/sections.h"
#include "map/prototype_store.h"
#include "map/summary_builder.h"
#include "protomark/error.h"

namespace protomark {
namespace {

// Descriptors that are encoded at a time, to bound the memory for their codes.
constexpr std::size_t kEncodeChunk = 1 << 13;
// Descriptors that a thread encodes at a time while another one adds.
constexpr std::size_t kLeastShare = 64, kMostShare = 512;

void check_pairs(std::size_t landmarks, std::size_t rows, const char* what) {
  if (landmarks != rows) {
    throw std::invalid_argument(std::to_string(landmarks) + " landmark ids for " +
                                std::to_string(rows) + " " + what);
  }
}

void check_codes(Codes codes, std::size_t dim) {
  if (codes.columns != dim) {
    throw std::invalid_argument("codes have " + std::to_string(codes.columns) +
                                " dimensions, the map has " + std::to_string(dim));
  }
  const std::int8_t* end = codes.data + codes.rows * codes.columns;
  if (std::find(codes.data, end, -128) != end) {
    throw std::invalid_argument("codes must be -127 to 127, one is -128");
  }
}

float mean(std::int64_t sum, std::int64_t n) {
  return static_cast<float>(static_cast<double>(sum) / static_cast<double>(n));
}

void check_new_ids(std::span<const std::int64_t> landmarks) {
  for (const std::int64_t id : landmarks) {
    if (id < 0) throw std::invalid_argument("landmark id " + std::to_string(id) + " is negative");
  }
}

}  // namespace

PrototypeMap::PrototypeMap(std::shared_ptr<const Encoder> encoder, std::size_t dim,
                           std::size_t look_bits)
    : encoder_(std::move(encoder)), dim_(dim) {
  if (encoder_ == nullptr) throw std::invalid_argument("a map needs an encoder");
  if (dim_ == 0) dim_ = encoder_->dim();
  const auto& dims = encoder_->dims();
  if (std::find(dims.begin(), dims.end(), dim_) == dims.end()) {
    throw std::invalid_argument("encoder '" + encoder_->info().name + "' has no codes of " +
                                std::to_string(dim_) + " dimensions");
  }
  const std::size_t most = std::min(kMaxLookBits, dim_);
  if (look_bits > most) {
    throw std::invalid_argument("look_bits must be 0 to " + std::to_string(most) + ", not " +
                                std::to_string(look_bits));
  }
  store_ = std::make_unique<Store>(dim_, look_bits);
}

PrototypeMap::PrototypeMap(PrototypeMap&& other) noexcept = default;
PrototypeMap::~PrototypeMap() = default;

std::size_t PrototypeMap::size() const {
  const std::shared_lock lock(store_->mutex);
  return store_->landmarks();
}

std::size_t PrototypeMap::prototype_count() const {
  const std::shared_lock lock(store_->mutex);
  return store_->rows();
}

std::size_t PrototypeMap::look_bits() const { return store_->look_bits(); }

std::vector<std::int64_t> PrototypeMap::ids() const {
  std::vector<std::int64_t> result;
  {
    const std::shared_lock lock(store_->mutex);
    result.reserve(store_->landmarks());
    for (const std::int64_t id : store_->ids()) {
      if (id >= 0) result.push_back(id);
    }
  }
  std::sort(result.begin(), result.end());
  return result;
}

void PrototypeMap::add(std::span<const std::int64_t> landmarks, Descriptors descriptors,
                       int threads) {
  check_pairs(landmarks.size(), descriptors.rows, "descriptors");
  check_new_ids(landmarks);
  std::vector<std::int8_t> buffer(std::min(descriptors.rows, 2 * kEncodeChunk) * dim_);
  const auto codes = [&](std::size_t begin) {
    return MatrixView<std::int8_t>{buffer.data() + begin / kEncodeChunk % 2 * kEncodeChunk * dim_,
                                   std::min(kEncodeChunk, descriptors.rows - begin), dim_};
  };
  const auto encode = [&](std::size_t begin, MatrixView<std::int8_t> to, int encode_threads) {
    encoder_->encode({descriptors.row(begin), to.rows, descriptors.columns}, to, encode_threads);
  };
  const auto add_chunk = [&](std::size_t begin) {
    const auto chunk = codes(begin);
    store_->add_in_pieces(landmarks.subspan(begin, chunk.rows), {chunk.data, chunk.rows, dim_},
                          threads);
  };
  const std::unique_lock changing(store_->changing);
  // Even no observation at all is checked for its length.
  encode(0, codes(0), threads);
  std::size_t begin = 0;
  for (std::size_t next = kEncodeChunk; next < descriptors.rows; next += kEncodeChunk) {
    const auto chunk = codes(next);
    if (store_->cells().nlist() == 0) {
      // One thread adds what is encoded and waits for memory, while the others go on encoding.
      const std::size_t n = std::clamp<std::size_t>(
          chunk.rows / (4 * static_cast<std::size_t>(threads)), kLeastShare, kMostShare);
      run_tasks(threads, 1 + (chunk.rows + n - 1) / n, [&](std::size_t task) {
        if (task == 0) return add_chunk(begin);
        const std::size_t first = (task - 1) * n;
        encode(next + first, {chunk.row(first), std::min(n, chunk.rows - first), dim_}, 1);
      });
    } else {
      // All threads share the work on cells.
      add_chunk(begin);
      encode(next, chunk, threads);
    }
    begin = next;
  }
  add_chunk(begin);
}

void PrototypeMap::add_codes(std::span<const std::int64_t> landmarks, Codes codes) {
  check_pairs(landmarks.size(), codes.rows, "codes");
  check_codes(codes, dim_);
  check_new_ids(landmarks);
  const std::unique_lock changing(store_->changing);
  store_->add_in_pieces(landmarks, codes, 1);
}

void PrototypeMap::remove(std::span<const std::int64_t> landmarks, Descriptors descriptors,
                          int threads) {
  check_pairs(landmarks.size(), descriptors.rows, "descriptors");
  std::vector<std::int8_t> codes(descriptors.rows * dim_);
  encoder_->encode(descriptors, {codes.data(), descriptors.rows, dim_}, threads);
  remove_codes(landmarks, {codes.data(), descriptors.rows, dim_});
}

void PrototypeMap::remove_codes(std::span<const std::int64_t> landmarks, Codes codes) {
  check_pairs(landmarks.size(), codes.rows, "codes");
  check_codes(codes, dim_);
  const std::unique_lock changing(store_->changing);

  // What is to be taken from each row, added up first so that all can be checked before any
  // changes.
  struct Part {
    std::vector<int> sum;
    int count = 0;
  };
  std::unordered_map<std::uint32_t, Part> parts;
  const auto never_added = [](std::int64_t id) {
    return std::invalid_argument("descriptors to be removed from landmark " + std::to_string(id) +
                                 " were never added to it");
  };
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const std::uint32_t row =
        store_->find_row(store_->at(landmarks[i]), store_->look_of(codes.row(i)));
    if (row == Store::kNone) throw never_added(landmarks[i]);
    Part& part = parts[row];
    part.sum.resize(dim_, 0);
    for (std::size_t d = 0; d < dim_; ++d) part.sum[d] += codes.row(i)[d];
    ++part.count;
  }
  for (const auto& [row, part] : parts) {
    const int left = store_->count(row) - part.count;
    const std::int64_t id = store_->ids()[store_->landmark_of(row)];
    if (left < 0) {
      throw std::invalid_argument("landmark " + std::to_string(id) + " has " +
                                  std::to_string(store_->count(row)) + " observations" +
                                  (look_bits() == 0 ? "" : " of one look") + ", " +
                                  std::to_string(part.count) + " cannot be removed");
    }
    for (std::size_t d = 0; d < dim_; ++d) {
      if (std::abs(store_->sum(row)[d] - part.sum[d]) > 127 * left) throw never_added(id);
    }
  }
  // By what does not change when others go.
  struct Key {
    std::int64_t id;
    std::uint16_t look;
    const Part* part;
  };
  std::vector<Key> keys;
  keys.reserve(parts.size());
  for (const auto& [row, part] : parts) {
    keys.push_back({store_->ids()[store_->landmark_of(row)], store_->look(row), &part});
  }
  store_->in_pieces(keys.size(), [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const std::uint32_t row = store_->find_row(store_->at(keys[i].id), keys[i].look);
      const Part& part = *keys[i].part;
      if (store_->count(row) == part.count) {
        store_->erase_row(row);
        continue;
      }
      for (std::size_t d = 0; d < dim_; ++d) {
        store_->sum(row)[d] = static_cast<std::int16_t>(store_->sum(row)[d] - part.sum[d]);
      }
      store_->set_count(row, store_->count(row) - part.count);
      store_->refresh(row);
    }
  });
}

void PrototypeMap::merge(std::span<const std::int64_t> into, std::span<const std::int64_t> source) {
  check_pairs(into.size(), source.size(), "sources");
  const std::unique_lock changing(store_->changing);
  IdSet gone;
  for (std::size_t i = 0; i < into.size(); ++i) {
    for (const std::int64_t id : {into[i], source[i]}) {
      store_->at(id);
      if (gone.contains(id)) {
        throw std::invalid_argument("landmark " + std::to_string(id) +
                                    " was merged into another earlier in the same call");
      }
    }
    if (into[i] == source[i]) {
      throw std::invalid_argument("landmark " + std::to_string(into[i]) +
                                  " cannot be merged into itself");
    }
    gone.insert(source[i]);
  }
  store_->in_pieces(into.size(), [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const std::uint32_t other = store_->at(source[i]);
      for (std::uint32_t from = store_->first_row(other); from != Store::kNone;
           from = store_->next_row(from)) {
        const std::uint32_t row = store_->find_or_create_row(into[i], store_->look(from));
        store_->join(row, store_->sum(from), store_->count(from));
      }
      const std::uint32_t landmark = store_->at(into[i]);
      if (is_nowhere(store_->position(landmark))) {
        store_->set_position(landmark, store_->position(other));
      }
      store_->erase(source[i]);
    }
  });
}

void PrototypeMap::discard(std::span<const std::int64_t> landmarks) {
  const std::unique_lock changing(store_->changing);
  std::vector<std::int64_t> sorted(landmarks.begin(), landmarks.end());
  std::sort(sorted.begin(), sorted.end());
  sorted.erase(std::unique(sorted.begin(), sorted.end()), sorted.end());
  for (const std::int64_t id : sorted) store_->at(id);
  store_->in_pieces(sorted.size(), [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) store_->erase(sorted[i]);
  });
}

Metadata PrototypeMap::metadata() const {
  const std::shared_lock lock(store_->mutex);
  return store_->metadata;
}

void PrototypeMap::set_metadata(Metadata metadata) {
  check_metadata(metadata);
  const std::unique_lock changing(store_->changing);
  const std::unique_lock lock(store_->mutex);
  store_->set_metadata(std::move(metadata));
}

void PrototypeMap::set_positions(std::span<const std::int64_t> landmarks,
                                 std::span<const Position> positions) {
  check_pairs(landmarks.size(), positions.size(), "positions");
  const std::unique_lock changing(store_->changing);
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    store_->at(landmarks[i]);
    const Position& p = positions[i];
    const bool finite = std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
    if (!finite && !is_nowhere(p)) {
      throw std::invalid_argument("position of landmark " + std::to_string(landmarks[i]) +
                                  " is not finite");
    }
  }
  if (!std::all_of(positions.begin(), positions.end(), is_nowhere)) {
    store_->make_room_for_positions();
  }
  store_->in_pieces(landmarks.size(), [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      store_->set_position(store_->at(landmarks[i]), positions[i]);
    }
  });
}

std::vector<Position> PrototypeMap::positions(std::span<const std::int64_t> landmarks) const {
  const std::shared_lock lock(store_->mutex);
  std::vector<Position> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) result.push_back(store_->position(store_->at(id)));
  return result;
}

std::vector<std::uint32_t> PrototypeMap::counts(std::span<const std::int64_t> landmarks) const {
  const std::shared_lock lock(store_->mutex);
  std::vector<std::uint32_t> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) result.push_back(store_->observations(store_->at(id)));
  return result;
}

MapSummary PrototypeMap::summary() const {
  const std::shared_lock changing(store_->changing);
  SummaryBuilder result;
  for (std::uint32_t i = 0; i < store_->ids().size(); ++i) {
    if (store_->ids()[i] < 0) continue;
    result.add(store_->observations(i), store_->position(i));
  }
  return result.take();
}

void PrototypeMap::prototypes(std::span<const std::int64_t> landmarks,
                              MatrixView<float> means) const {
  if (means.rows != landmarks.size() || means.columns != dim_) {
    throw std::invalid_argument("means must be landmarks x dim");
  }
  const std::shared_lock lock(store_->mutex);
  std::vector<std::int64_t> sum(dim_);
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    std::fill(sum.begin(), sum.end(), 0);
    std::int64_t n = 0;
    for (std::uint32_t row = store_->first_row(store_->at(landmarks[i])); row != Store::kNone;
         row = store_->next_row(row)) {
      for (std::size_t d = 0; d < dim_; ++d) sum[d] += store_->sum(row)[d];
      n += store_->count(row);
    }
    for (std::size_t d = 0; d < dim_; ++d) means.row(i)[d] = mean(sum[d], n);
  }
}

std::vector<Look> PrototypeMap::looks(std::int64_t landmark) const {
  const std::shared_lock lock(store_->mutex);
  std::vector<Look> result;
  for (const std::uint32_t row : store_->sorted_rows(store_->at(landmark))) {
    Look look{std::vector<float>(dim_), store_->count(row)};
    for (std::size_t d = 0; d < dim_; ++d) look.mean[d] = mean(store_->sum(row)[d], look.count);
    result.push_back(std::move(look));
  }
  return result;
}

void PrototypeMap::search(Descriptors queries, const SearchOptions& options,
                          MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) const {
  std::vector<std::int8_t> codes(queries.rows * dim_);
  encoder_->encode(queries, {codes.data(), queries.rows, dim_}, options.threads);
  search_codes({codes.data(), queries.rows, dim_}, options, ids, distances);
}

}  // namespace protomark
