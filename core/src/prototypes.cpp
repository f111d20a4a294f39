#include "protomark/prototypes.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <mutex>
#include <numeric>
#include <stdexcept>
#include <string>
#include <unordered_map>

#include "container.h"
#include "id_index.h"
#include "map_sections.h"
#include "protomark/error.h"
#include "quantize4.h"

namespace protomark {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr Position kNowhere = {kNaN, kNaN, kNaN};

// Descriptors that are encoded and added at a time, to bound the memory for their codes.
constexpr std::size_t kEncodeChunk = 1 << 16;

bool is_nowhere(const Position& p) {
  return std::isnan(p[0]) && std::isnan(p[1]) && std::isnan(p[2]);
}

// The mean rounded to the nearest integer, halves away from zero.
std::int8_t rounded_mean(int sum, int n) {
  const int magnitude = (2 * std::abs(sum) + n) / (2 * n);
  return static_cast<std::int8_t>(sum < 0 ? -magnitude : magnitude);
}

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

void check_new_ids(std::span<const std::int64_t> landmarks) {
  for (const std::int64_t id : landmarks) {
    if (id < 0) throw std::invalid_argument("landmark id " + std::to_string(id) + " is negative");
  }
}

}  // namespace

// Landmarks in the order they came, unsorted; row r of every array is one landmark.
struct PrototypeMap::Store {
  explicit Store(std::size_t dim) : dim(dim) {}

  std::size_t dim;
  std::vector<std::int64_t> ids;
  std::vector<std::int16_t> sums;  // rows x dim
  std::vector<std::uint8_t> counts;
  std::vector<std::int8_t> packed;  // rounded means, see PackedPrototypes
  std::vector<Position> positions;  // empty while no landmark has one
  IdIndex index;
  mutable std::shared_mutex mutex;

  std::int16_t* sum(std::uint32_t row) { return &sums[row * dim]; }
  const std::int16_t* sum(std::uint32_t row) const { return &sums[row * dim]; }

  std::uint32_t find(std::int64_t id) const { return index.find(ids, id); }

  std::uint32_t at(std::int64_t id) const {
    const std::uint32_t row = find(id);
    if (row == IdIndex::kNone) throw UnknownLandmark(id);
    return row;
  }

  std::uint32_t find_or_create(std::int64_t id) {
    const std::uint32_t found = find(id);
    if (found != IdIndex::kNone) return found;
    if (ids.size() >= IdIndex::kNone) throw std::length_error("a map holds under 2^32 landmarks");
    const auto row = static_cast<std::uint32_t>(ids.size());
    ids.push_back(id);
    sums.resize(sums.size() + dim, 0);
    counts.push_back(0);
    packed.resize(packed_size(ids.size(), dim), 0);
    if (!positions.empty()) positions.push_back(kNowhere);
    index.insert(ids, row);
    return row;
  }

  // The last row takes the place of the one that goes.
  void erase(std::int64_t id) {
    const std::uint32_t row = at(id);
    const auto last = static_cast<std::uint32_t>(ids.size() - 1);
    index.erase(ids, id);
    if (row != last) {
      index.move(ids, ids[last], row);
      ids[row] = ids[last];
      std::copy_n(sum(last), dim, sum(row));
      counts[row] = counts[last];
      if (!positions.empty()) positions[row] = positions[last];
      refresh(row);
    }
    for (std::size_t d = 0; d < dim; ++d) packed[packed_index(last, d, dim)] = 0;
    ids.pop_back();
    sums.resize(sums.size() - dim);
    counts.pop_back();
    if (!positions.empty()) positions.pop_back();
    packed.resize(packed_size(ids.size(), dim));
  }

  void refresh(std::uint32_t row) {
    for (std::size_t d = 0; d < dim; ++d) {
      packed[packed_index(row, d, dim)] = rounded_mean(sum(row)[d], counts[row]);
    }
  }

  // Eq. 2.
  void add(std::int64_t id, const std::int8_t* code) {
    const std::uint32_t row = find_or_create(id);
    std::int16_t* s = sum(row);
    if (counts[row] == kMaxCount) {
      for (std::size_t d = 0; d < dim; ++d) s[d] = static_cast<std::int16_t>(s[d] / 2);
      counts[row] /= 2;
    }
    for (std::size_t d = 0; d < dim; ++d) s[d] = static_cast<std::int16_t>(s[d] + code[d]);
    ++counts[row];
  }

  // Sums of both, halved until the count fits.
  void join(std::uint32_t row, const std::int16_t* other, int other_count) {
    int n = counts[row] + other_count;
    const int halvings = n > kMaxCount ? 1 : 0;  // 255 + 255 needs one at most
    std::int16_t* s = sum(row);
    for (std::size_t d = 0; d < dim; ++d) {
      const int total = s[d] + other[d];
      s[d] = static_cast<std::int16_t>(halvings != 0 ? total / 2 : total);
    }
    counts[row] = static_cast<std::uint8_t>(n >> halvings);
    refresh(row);
  }

  void set_position(std::uint32_t row, const Position& position) {
    if (positions.empty()) {
      if (is_nowhere(position)) return;
      positions.assign(ids.size(), kNowhere);
    }
    positions[row] = position;
  }

  Position position(std::uint32_t row) const {
    return positions.empty() ? kNowhere : positions[row];
  }

  PackedPrototypes view() const { return {packed.data(), ids.size(), dim, ids.data()}; }

  std::vector<std::uint32_t> rows_by_id() const {
    std::vector<std::uint32_t> rows(ids.size());
    std::iota(rows.begin(), rows.end(), 0u);
    std::sort(rows.begin(), rows.end(),
              [&](std::uint32_t a, std::uint32_t b) { return ids[a] < ids[b]; });
    return rows;
  }

  // Of the numbers of the rounded prototypes.
  Occurrences occurrences() const {
    Occurrences result{};
    for (std::size_t row = 0; row < ids.size(); ++row) {
      for (std::size_t d = 0; d < dim; ++d) {
        ++result[static_cast<std::size_t>(packed[packed_index(row, d, dim)] + 128)];
      }
    }
    return result;
  }

  // Rounded prototypes of some rows, as PackedPrototypes has them ...
  std::vector<std::uint8_t> pack8(std::span<const std::uint32_t> rows) const {
    std::vector<std::uint8_t> result(packed_size(rows.size(), dim), 0);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      for (std::size_t d = 0; d < dim; ++d) {
        result[packed_index(i, d, dim)] =
            static_cast<std::uint8_t>(packed[packed_index(rows[i], d, dim)]);
      }
    }
    return result;
  }

  // ... and as PackedPrototypes4.
  std::vector<std::uint8_t> pack4(std::span<const std::uint32_t> rows, int half_step) const {
    std::vector<std::uint8_t> result(packed4_size(rows.size(), dim), 0);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      for (std::size_t d = 0; d < dim; ++d) {
        const std::uint8_t u = quantize4(packed[packed_index(rows[i], d, dim)], half_step);
        result[packed4_index(i, d, dim)] |= static_cast<std::uint8_t>(packed4_high(d) ? u << 4 : u);
      }
    }
    return result;
  }
};

PrototypeMap::PrototypeMap(std::shared_ptr<const Encoder> encoder, std::size_t dim)
    : encoder_(std::move(encoder)), dim_(dim) {
  if (encoder_ == nullptr) throw std::invalid_argument("a map needs an encoder");
  if (dim_ == 0) dim_ = encoder_->dim();
  const auto& dims = encoder_->dims();
  if (std::find(dims.begin(), dims.end(), dim_) == dims.end()) {
    throw std::invalid_argument("encoder '" + encoder_->info().name + "' has no codes of " +
                                std::to_string(dim_) + " dimensions");
  }
  store_ = std::make_unique<Store>(dim_);
}

PrototypeMap::PrototypeMap(PrototypeMap&& other) noexcept = default;
PrototypeMap::~PrototypeMap() = default;

std::size_t PrototypeMap::size() const {
  const std::shared_lock lock(store_->mutex);
  return store_->ids.size();
}

std::vector<std::int64_t> PrototypeMap::ids() const {
  const std::shared_lock lock(store_->mutex);
  std::vector<std::int64_t> result = store_->ids;
  std::sort(result.begin(), result.end());
  return result;
}

void PrototypeMap::add(std::span<const std::int64_t> landmarks, Descriptors descriptors,
                       int threads) {
  check_pairs(landmarks.size(), descriptors.rows, "descriptors");
  check_new_ids(landmarks);
  std::vector<std::int8_t> buffer(std::min(descriptors.rows, kEncodeChunk) * dim_);
  // Even no observation at all is checked for its length.
  for (std::size_t begin = 0; begin == 0 || begin < descriptors.rows; begin += kEncodeChunk) {
    const std::size_t n = std::min(kEncodeChunk, descriptors.rows - begin);
    encoder_->encode({descriptors.row(begin), n, descriptors.columns}, {buffer.data(), n, dim_},
                     threads);
    add_codes(landmarks.subspan(begin, n), {buffer.data(), n, dim_});
  }
}

void PrototypeMap::add_codes(std::span<const std::int64_t> landmarks, Codes codes) {
  check_pairs(landmarks.size(), codes.rows, "codes");
  check_codes(codes, dim_);
  check_new_ids(landmarks);
  const std::unique_lock lock(store_->mutex);
  for (std::size_t i = 0; i < landmarks.size(); ++i) store_->add(landmarks[i], codes.row(i));
  for (const std::int64_t id : landmarks) store_->refresh(store_->at(id));
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
  const std::unique_lock lock(store_->mutex);

  // What is to be taken from each landmark, added up first so that all can be checked before any
  // changes.
  struct Part {
    std::vector<int> sum;
    int count = 0;
  };
  std::unordered_map<std::int64_t, Part> parts;
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    store_->at(landmarks[i]);
    Part& part = parts[landmarks[i]];
    part.sum.resize(dim_, 0);
    for (std::size_t d = 0; d < dim_; ++d) part.sum[d] += codes.row(i)[d];
    ++part.count;
  }
  for (const auto& [id, part] : parts) {
    const std::uint32_t row = store_->at(id);
    const int left = store_->counts[row] - part.count;
    const std::string landmark = "landmark " + std::to_string(id);
    if (left < 0) {
      throw std::invalid_argument(landmark + " has " + std::to_string(store_->counts[row]) +
                                  " observations, " + std::to_string(part.count) +
                                  " cannot be removed");
    }
    for (std::size_t d = 0; d < dim_; ++d) {
      if (std::abs(store_->sum(row)[d] - part.sum[d]) > 127 * left) {
        throw std::invalid_argument("descriptors to be removed from " + landmark +
                                    " were never added to it");
      }
    }
  }
  for (const auto& [id, part] : parts) {
    const std::uint32_t row = store_->at(id);
    if (store_->counts[row] == part.count) {
      store_->erase(id);
      continue;
    }
    for (std::size_t d = 0; d < dim_; ++d) {
      store_->sum(row)[d] = static_cast<std::int16_t>(store_->sum(row)[d] - part.sum[d]);
    }
    store_->counts[row] = static_cast<std::uint8_t>(store_->counts[row] - part.count);
    store_->refresh(row);
  }
}

void PrototypeMap::merge(std::span<const std::int64_t> into, std::span<const std::int64_t> source) {
  check_pairs(into.size(), source.size(), "sources");
  const std::unique_lock lock(store_->mutex);
  std::unordered_map<std::int64_t, bool> gone;
  for (std::size_t i = 0; i < into.size(); ++i) {
    for (const std::int64_t id : {into[i], source[i]}) {
      store_->at(id);
      if (gone[id]) {
        throw std::invalid_argument("landmark " + std::to_string(id) +
                                    " was merged into another earlier in the same call");
      }
    }
    if (into[i] == source[i]) {
      throw std::invalid_argument("landmark " + std::to_string(into[i]) +
                                  " cannot be merged into itself");
    }
    gone[source[i]] = true;
  }
  for (std::size_t i = 0; i < into.size(); ++i) {
    const std::uint32_t row = store_->at(into[i]);
    const std::uint32_t other = store_->at(source[i]);
    store_->join(row, store_->sum(other), store_->counts[other]);
    if (is_nowhere(store_->position(row))) store_->set_position(row, store_->position(other));
    store_->erase(source[i]);
  }
}

void PrototypeMap::discard(std::span<const std::int64_t> landmarks) {
  const std::unique_lock lock(store_->mutex);
  std::vector<std::int64_t> sorted(landmarks.begin(), landmarks.end());
  std::sort(sorted.begin(), sorted.end());
  sorted.erase(std::unique(sorted.begin(), sorted.end()), sorted.end());
  for (const std::int64_t id : sorted) store_->at(id);
  for (const std::int64_t id : sorted) store_->erase(id);
}

void PrototypeMap::update(const PrototypeMap& other) {
  if (&other == this) throw std::invalid_argument("a map cannot be joined to itself");
  if (other.encoder_->identity() != encoder_->identity() || other.dim_ != dim_) {
    throw std::invalid_argument("maps of different encoders or dimensions cannot be joined: '" +
                                encoder_->info().name + "' with " + std::to_string(dim_) + ", '" +
                                other.encoder_->info().name + "' with " +
                                std::to_string(other.dim_));
  }
  const std::scoped_lock lock(store_->mutex, other.store_->mutex);
  const Store& from = *other.store_;
  for (std::uint32_t i = 0; i < from.ids.size(); ++i) {
    const std::uint32_t row = store_->find_or_create(from.ids[i]);
    store_->join(row, from.sum(i), from.counts[i]);
    if (is_nowhere(store_->position(row))) store_->set_position(row, from.position(i));
  }
}

void PrototypeMap::set_positions(std::span<const std::int64_t> landmarks,
                                 std::span<const Position> positions) {
  check_pairs(landmarks.size(), positions.size(), "positions");
  const std::unique_lock lock(store_->mutex);
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    store_->at(landmarks[i]);
    const Position& p = positions[i];
    const bool finite = std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
    if (!finite && !is_nowhere(p)) {
      throw std::invalid_argument("position of landmark " + std::to_string(landmarks[i]) +
                                  " is not finite");
    }
  }
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    store_->set_position(store_->at(landmarks[i]), positions[i]);
  }
}

std::vector<Position> PrototypeMap::positions(std::span<const std::int64_t> landmarks) const {
  const std::shared_lock lock(store_->mutex);
  std::vector<Position> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) result.push_back(store_->position(store_->at(id)));
  return result;
}

std::vector<std::uint8_t> PrototypeMap::counts(std::span<const std::int64_t> landmarks) const {
  const std::shared_lock lock(store_->mutex);
  std::vector<std::uint8_t> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) result.push_back(store_->counts[store_->at(id)]);
  return result;
}

void PrototypeMap::prototypes(std::span<const std::int64_t> landmarks,
                              MatrixView<float> means) const {
  if (means.rows != landmarks.size() || means.columns != dim_) {
    throw std::invalid_argument("means must be landmarks x dim");
  }
  const std::shared_lock lock(store_->mutex);
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const std::uint32_t row = store_->at(landmarks[i]);
    for (std::size_t d = 0; d < dim_; ++d) {
      means.row(i)[d] =
          static_cast<float>(store_->sum(row)[d]) / static_cast<float>(store_->counts[row]);
    }
  }
}

void PrototypeMap::search(Descriptors queries, const SearchOptions& options,
                          MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  std::vector<std::int8_t> codes(queries.rows * dim_);
  encoder_->encode(queries, {codes.data(), queries.rows, dim_}, options.threads);
  search_codes({codes.data(), queries.rows, dim_}, options, ids, distances);
}

void PrototypeMap::search_codes(Codes queries, const SearchOptions& options,
                                MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  const std::shared_lock lock(store_->mutex);
  protomark::search(store_->view(), queries, options, ids, distances);
}

void PrototypeMap::save(const std::filesystem::path& path) const {
  const std::shared_lock lock(store_->mutex);
  const auto rows = store_->rows_by_id();
  const std::size_t n = rows.size();
  std::vector<std::int64_t> ids(n);
  std::vector<std::uint8_t> counts(n);
  std::vector<std::int16_t> sums(n * dim_);
  std::vector<Position> positions(store_->positions.empty() ? 0 : n);
  for (std::size_t i = 0; i < n; ++i) {
    ids[i] = store_->ids[rows[i]];
    counts[i] = store_->counts[rows[i]];
    std::copy_n(store_->sum(rows[i]), dim_, &sums[i * dim_]);
    if (!positions.empty()) positions[i] = store_->positions[rows[i]];
  }
  // A map whose positions were all taken away equals one that never had any.
  if (std::all_of(positions.begin(), positions.end(), is_nowhere)) positions.clear();

  ContainerWriter file(FileKind::open_map);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape({n, dim_, {}}));
  file.add(section::kIds, std::as_bytes(std::span(ids)));
  file.add(section::kCounts, std::as_bytes(std::span(counts)));
  file.add(section::kSums, std::as_bytes(std::span(sums)));
  if (!positions.empty()) file.add(section::kPositions, std::as_bytes(std::span(positions)));
  file.write(path);
}

PrototypeMap PrototypeMap::load(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  file.expect(FileKind::open_map);
  auto encoder = read_encoder(file);
  const MapShape shape = read_shape(file, *encoder);
  const std::size_t n = shape.landmarks;

  PrototypeMap map(std::move(encoder), shape.dim);
  Store& store = *map.store_;
  store.ids = read_section<std::int64_t>(file, section::kIds, n);
  store.counts = read_section<std::uint8_t>(file, section::kCounts, n);
  store.sums = read_section<std::int16_t>(file, section::kSums, n * shape.dim);
  if (file.map_if_there(section::kPositions)) {
    store.positions = read_section<Position>(file, section::kPositions, n);
  }
  check_ids(file, store.ids);
  store.packed.resize(packed_size(n, shape.dim), 0);
  for (std::uint32_t row = 0; row < n; ++row) {
    const int count = store.counts[row];
    const std::int16_t* sum = store.sum(row);
    if (count == 0 ||
        std::any_of(sum, sum + shape.dim, [&](int s) { return std::abs(s) > 127 * count; })) {
      file.fail("landmark " + std::to_string(store.ids[row]) + " has an impossible prototype");
    }
    const Position position = store.position(row);
    if (!is_nowhere(position) &&
        !(std::isfinite(position[0]) && std::isfinite(position[1]) && std::isfinite(position[2]))) {
      file.fail("landmark " + std::to_string(store.ids[row]) + " has no finite position");
    }
    store.refresh(row);
    store.index.insert(store.ids, row);
  }
  return map;
}

void PrototypeMap::seal(const std::filesystem::path& path, int bits) const {
  if (bits != 8 && bits != 4) {
    throw std::invalid_argument("prototypes are sealed with 8 or 4 bits a number, not " +
                                std::to_string(bits));
  }
  const std::shared_lock lock(store_->mutex);
  const auto rows = store_->rows_by_id();
  const std::size_t n = rows.size();
  std::vector<std::int64_t> ids(n);
  std::vector<std::uint8_t> counts(n);
  for (std::size_t i = 0; i < n; ++i) {
    ids[i] = store_->ids[rows[i]];
    counts[i] = store_->counts[rows[i]];
  }
  const int half_step = bits == 4 ? best_half_step(store_->occurrences()) : 0;
  const std::vector<std::uint8_t> packed =
      bits == 4 ? store_->pack4(rows, half_step) : store_->pack8(rows);
  MapShape shape{n, dim_, {}};
  std::vector<std::array<float, 3>> positions;
  if (!std::all_of(store_->positions.begin(), store_->positions.end(), is_nowhere)) {
    shape.origin = middle(store_->positions);
    for (const std::uint32_t row : rows) {
      const Position& p = store_->positions[row];
      positions.push_back({static_cast<float>(p[0] - shape.origin[0]),
                           static_cast<float>(p[1] - shape.origin[1]),
                           static_cast<float>(p[2] - shape.origin[2])});
    }
  }
  const bool implicit_ids = n == 0 || (ids.front() == 0 && ids.back() == std::int64_t(n) - 1);

  ContainerWriter file(FileKind::sealed_map, bits == 4 ? 2 : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape(shape));
  if (!implicit_ids) file.add(section::kIds, std::as_bytes(std::span(ids)));
  file.add(section::kCounts, std::as_bytes(std::span(counts)));
  if (bits == 4) file.add(section::kLevels, write_levels(half_step));
  file.add(section::kPrototypes, std::as_bytes(std::span(packed)));
  if (!positions.empty()) file.add(section::kPositions, std::as_bytes(std::span(positions)));
  file.write(path);
}

}  // namespace protomark
