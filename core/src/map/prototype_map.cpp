// What a learning map tells of its landmarks.
#include "protomark/prototype_map.h"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "map/map_state.h"
#include "map/positions.h"

namespace protomark {
namespace {

float mean(std::int64_t sum, std::int64_t n) {
  return static_cast<float>(static_cast<double>(sum) / static_cast<double>(n));
}

std::unique_ptr<MapState> make_state(std::shared_ptr<const Encoder> encoder, std::size_t dim,
                                     std::size_t appearance_bits) {
  if (encoder == nullptr) throw std::invalid_argument("a map needs an encoder");
  if (dim == 0) dim = encoder->dim();
  if (std::ranges::find(encoder->dims(), dim) == encoder->dims().end()) {
    throw std::invalid_argument("encoder '" + encoder->info().name + "' has no codes of " +
                                std::to_string(dim) + " dimensions");
  }
  const std::size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  if (appearance_bits > limit) {
    throw std::invalid_argument("appearance_bits must be 0 to " + std::to_string(limit) + ", not " +
                                std::to_string(appearance_bits));
  }
  return std::make_unique<MapState>(std::move(encoder), dim, appearance_bits);
}

}  // namespace

PrototypeMap::PrototypeMap(std::shared_ptr<const Encoder> encoder, std::size_t dim,
                           std::size_t appearance_bits)
    : PrototypeMap(make_state(std::move(encoder), dim, appearance_bits)) {}
PrototypeMap::PrototypeMap(std::unique_ptr<MapState> state) : state_(std::move(state)) {}
PrototypeMap::PrototypeMap(PrototypeMap&& other) noexcept = default;
PrototypeMap::~PrototypeMap() = default;

const std::shared_ptr<const Encoder>& PrototypeMap::encoder() const { return state_->encoder; }
std::size_t PrototypeMap::dim() const { return state_->store.dim(); }
std::size_t PrototypeMap::appearance_bits() const { return state_->store.appearance_bits(); }

std::size_t PrototypeMap::size() const {
  const std::shared_lock lock(state_->searching);
  return state_->store.landmark_count();
}

std::size_t PrototypeMap::prototype_count() const {
  const std::shared_lock lock(state_->searching);
  return state_->store.prototype_count();
}

std::vector<std::int64_t> PrototypeMap::ids() const {
  std::vector<std::int64_t> result;
  {
    const std::shared_lock lock(state_->searching);
    result.reserve(state_->store.landmark_count());
    std::ranges::copy_if(state_->store.ids(), std::back_inserter(result),
                         [](std::int64_t id) { return id >= 0; });
  }
  std::ranges::sort(result);
  return result;
}

Metadata PrototypeMap::metadata() const {
  const std::shared_lock lock(state_->searching);
  return state_->metadata;
}

std::vector<Position> PrototypeMap::positions(std::span<const std::int64_t> ids) const {
  const std::shared_lock lock(state_->searching);
  std::vector<Position> result;
  result.reserve(ids.size());
  for (const std::int64_t id : ids) result.push_back(state_->store.position(state_->store.at(id)));
  return result;
}

std::vector<std::uint32_t> PrototypeMap::counts(std::span<const std::int64_t> ids) const {
  const std::shared_lock lock(state_->searching);
  std::vector<std::uint32_t> result;
  result.reserve(ids.size());
  for (const std::int64_t id : ids) {
    result.push_back(state_->store.observations(state_->store.at(id)));
  }
  return result;
}

Matrix<float> PrototypeMap::prototypes(std::span<const std::int64_t> ids) const {
  const PrototypeStore& store = state_->store;
  Matrix<float> means(ids.size(), dim());
  std::vector<std::int64_t> sum(dim());
  const std::shared_lock lock(state_->searching);
  for (std::size_t i = 0; i < ids.size(); ++i) {
    std::ranges::fill(sum, 0);
    std::int64_t n = 0;
    for (const Row row : store.rows(store.at(ids[i]))) {
      for (std::size_t d = 0; d < dim(); ++d) sum[d] += store.sum(row)[d];
      n += store.count(row);
    }
    for (std::size_t d = 0; d < dim(); ++d) means.row(i)[d] = mean(sum[d], n);
  }
  return means;
}

Matrix<float> PrototypeMap::appearances(std::int64_t id) const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->searching);
  const std::vector<Row> rows = store.sorted_rows(store.at(id));
  Matrix<float> means(rows.size(), dim());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    for (std::size_t d = 0; d < dim(); ++d) {
      means.row(i)[d] = mean(store.sum(rows[i])[d], store.count(rows[i]));
    }
  }
  return means;
}

std::vector<std::uint32_t> PrototypeMap::appearance_counts(std::int64_t id) const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->searching);
  std::vector<std::uint32_t> result;
  for (const Row row : store.sorted_rows(store.at(id))) {
    result.push_back(static_cast<std::uint32_t>(store.count(row)));
  }
  return result;
}

MapSummary PrototypeMap::summary() const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->changing);
  SummaryBuilder result;
  for (LandmarkIndex l{0}; l.value < store.ids().size(); ++l.value) {
    if (store.id(l) >= 0) result.add(store.observations(l), store.position(l));
  }
  return result.take();
}

}  // namespace protomark
