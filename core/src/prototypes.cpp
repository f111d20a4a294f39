#include "protomark/prototypes.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <mutex>
#include <stdexcept>
#include <string>
#include <unordered_map>

#include "container.h"
#include "map_sections.h"
#include "protomark/error.h"
#include "prototype_store.h"
#include "summary_builder.h"

namespace protomark {
namespace {

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
  std::vector<std::int8_t> buffer(std::min(descriptors.rows, Store::kPiece) * dim_);
  const std::unique_lock changing(store_->changing);
  // Even no observation at all is checked for its length.
  for (std::size_t begin = 0; begin == 0 || begin < descriptors.rows; begin += Store::kPiece) {
    const std::size_t n = std::min(Store::kPiece, descriptors.rows - begin);
    const MatrixView<std::int8_t> codes{buffer.data(), n, dim_};
    encoder_->encode({descriptors.row(begin), n, descriptors.columns}, codes, threads);
    store_->add_piece(landmarks.subspan(begin, n), {buffer.data(), n, dim_}, threads);
  }
}

void PrototypeMap::add_codes(std::span<const std::int64_t> landmarks, Codes codes) {
  check_pairs(landmarks.size(), codes.rows, "codes");
  check_codes(codes, dim_);
  check_new_ids(landmarks);
  const std::unique_lock changing(store_->changing);
  for (std::size_t begin = 0; begin < codes.rows; begin += Store::kPiece) {
    const std::size_t n = std::min(Store::kPiece, codes.rows - begin);
    store_->add_piece(landmarks.subspan(begin, n), {codes.row(begin), n, dim_}, 1);
  }
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
  store_->metadata = std::move(metadata);
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
  const std::shared_lock lock(store_->mutex);
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
                          MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  std::vector<std::int8_t> codes(queries.rows * dim_);
  encoder_->encode(queries, {codes.data(), queries.rows, dim_}, options.threads);
  search_codes({codes.data(), queries.rows, dim_}, options, ids, distances);
}

void PrototypeMap::save(const std::filesystem::path& path) const {
  const std::shared_lock changing(store_->changing);
  const bool with_looks = look_bits() != 0;
  const auto landmarks = store_->sorted_landmarks();
  // Without looks a row is a landmark.
  const auto looks = with_looks ? store_->sorted_rows() : std::vector<std::uint32_t>();
  const auto& rows = with_looks ? looks : landmarks;
  const std::size_t n = landmarks.size(), m = rows.size();
  const std::vector<std::int8_t>& cells = store_->cells().centroids();

  ContainerWriter file(FileKind::open_map, !cells.empty() ? 3 : with_looks ? 2 : 1);
  file.add(section::kEncoder, encoder_->serialize());
  file.add(section::kShape, write_shape({n, dim_, {}}));
  add_metadata(file, store_->metadata);
  add_values<std::int64_t>(file, section::kIds, n, 1, [&](std::size_t i, std::int64_t* to) {
    *to = store_->ids()[landmarks[i]];
  });
  if (with_looks) {
    file.add(section::kLookBits, write_look_bits(look_bits()));
    add_values<std::uint32_t>(file, section::kRows, n, 1, [&](std::size_t i, std::uint32_t* to) {
      *to = static_cast<std::uint32_t>(store_->rows_of(landmarks[i]));
    });
    add_values<std::uint16_t>(file, section::kLooks, m, 1, [&](std::size_t i, std::uint16_t* to) {
      *to = store_->look(rows[i]);
    });
  }
  add_values<std::uint8_t>(file, section::kCounts, m, 1,
                           [&](std::size_t i, std::uint8_t* to) { *to = store_->count(rows[i]); });
  add_values<std::int16_t>(file, section::kSums, m, dim_, [&](std::size_t i, std::int16_t* to) {
    std::copy_n(store_->sum(rows[i]), dim_, to);
  });
  // A map whose positions were all taken away equals one that never had any.
  if (!std::all_of(store_->positions().begin(), store_->positions().end(), is_nowhere)) {
    add_values<Position>(file, section::kPositions, n, 1, [&](std::size_t i, Position* to) {
      *to = store_->position(landmarks[i]);
    });
  }
  if (!cells.empty()) file.add(section::kCells, std::as_bytes(std::span(cells)));
  file.write(path);
}

PrototypeMap PrototypeMap::load(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  return parse(mapped.bytes(), path.string());
}

PrototypeMap PrototypeMap::parse(std::span<const std::byte> bytes, const std::string& name) {
  const ContainerReader file(bytes, name);
  file.expect(FileKind::open_map);
  auto encoder = read_encoder(file);
  const MapShape shape = read_shape(file, *encoder);
  const std::size_t n = shape.landmarks, dim = shape.dim;
  const std::size_t look_bits = read_look_bits(file, dim);
  const auto ids = read_section<std::int64_t>(file, section::kIds, n);
  check_ids(file, ids);
  std::vector<std::uint32_t> rows_of;
  std::size_t m = n;
  if (look_bits != 0) {
    rows_of = read_section<std::uint32_t>(file, section::kRows, n);
    m = count_rows(file, std::span<const std::uint32_t>(rows_of));
  }
  std::vector<std::uint16_t> looks;
  if (look_bits != 0) looks = read_section<std::uint16_t>(file, section::kLooks, m);
  const auto counts = read_section<std::uint8_t>(file, section::kCounts, m);
  const auto sums = read_section<std::int16_t>(file, section::kSums, m * dim);
  std::vector<Position> positions;
  if (file.map_if_there(section::kPositions)) {
    positions = read_section<Position>(file, section::kPositions, n);
  }

  PrototypeMap map(std::move(encoder), dim, look_bits);
  Store& store = *map.store_;
  store.metadata = read_metadata(file);
  store.reserve(n, m);
  for (std::size_t i = 0, next = 0; i < n; ++i) {
    const std::uint32_t landmark = store.create_landmark(ids[i]);
    const std::size_t end = next + (look_bits != 0 ? rows_of[i] : 1);
    for (const std::size_t first = next; next < end; ++next) {
      const int count = counts[next];
      const std::int16_t* sum = &sums[next * dim];
      if (count == 0 ||
          std::any_of(sum, sum + dim, [&](int s) { return std::abs(s) > 127 * count; })) {
        file.fail("landmark " + std::to_string(ids[i]) + " has an impossible prototype");
      }
      if (look_bits != 0 &&
          (looks[next] >> look_bits != 0 || (next > first && looks[next] <= looks[next - 1]))) {
        file.fail("the looks of landmark " + std::to_string(ids[i]) + " do not ascend");
      }
      const std::uint32_t row = store.create_row(landmark, look_bits != 0 ? looks[next] : 0);
      std::copy_n(sum, dim, store.sum(row));
      store.set_count(row, count);
      store.refresh(row);
    }
    if (positions.empty()) continue;
    const Position& p = positions[i];
    const bool finite = std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
    if (!finite && !is_nowhere(p)) {
      file.fail("landmark " + std::to_string(ids[i]) + " has no finite position");
    }
  }
  // After the landmarks, so that room for positions is made once.
  for (std::uint32_t i = 0; i < positions.size(); ++i) store.set_position(i, positions[i]);
  if (auto cells = read_cells(file, dim); !cells.empty()) {
    store.replace(store.with_cells({std::move(cells), dim}, 1));
  }
  return map;
}

}  // namespace protomark
