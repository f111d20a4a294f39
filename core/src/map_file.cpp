#include "protomark/map_file.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

#include "container.h"
#include "map_sections.h"
#include "protomark/error.h"

namespace protomark {

MapKind map_kind(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  if (file.kind() == FileKind::open_map) return MapKind::open;
  file.expect(FileKind::sealed_map);
  return MapKind::sealed;
}

std::vector<std::pair<std::string, std::size_t>> file_sections(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  return ContainerReader(mapped.bytes(), path.string()).sections();
}

void verify_file(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  ContainerReader(mapped.bytes(), path.string()).verify();
}

struct SealedMap::Content {
  explicit Content(const std::filesystem::path& path)
      : mapped(path), file(mapped.bytes(), path.string()) {
    file.expect(FileKind::sealed_map);
    encoder = read_encoder(file);
    shape = read_shape(file, *encoder);
    const std::size_t n = shape.landmarks;
    prototypes = map<std::int8_t>(section::kPrototypes, packed_size(n, shape.dim));
    counts = map<std::uint8_t>(section::kCounts, n);
    if (const auto bytes = file.read_if_there(section::kIds)) {
      ids = map<std::int64_t>(section::kIds, n);
      check_ids(file, {ids, n});
    }
    if (file.map_if_there(section::kPositions)) {
      positions = map<std::array<float, 3>>(section::kPositions, n);
    }
  }

  // Sections stand at multiples of 64 bytes, so the pointer is aligned.
  template <typename T>
  const T* map(const char* name, std::size_t n) {
    const auto bytes = file.map_if_there(name);
    if (!bytes) file.fail("it lacks the section '" + std::string(name) + "'");
    if (bytes->size() % sizeof(T) != 0 || bytes->size() / sizeof(T) != n) {
      file.fail("its section '" + std::string(name) + "' has the wrong size");
    }
    return reinterpret_cast<const T*>(bytes->data());
  }

  std::size_t at(std::int64_t id) const {
    const std::size_t n = shape.landmarks;
    if (ids == nullptr) {
      if (id < 0 || static_cast<std::size_t>(id) >= n) throw UnknownLandmark(id);
      return static_cast<std::size_t>(id);
    }
    const std::int64_t* found = std::lower_bound(ids, ids + n, id);
    if (found == ids + n || *found != id) throw UnknownLandmark(id);
    return static_cast<std::size_t>(found - ids);
  }

  MappedFile mapped;
  ContainerReader file;
  std::shared_ptr<const Encoder> encoder;
  MapShape shape;
  const std::int8_t* prototypes = nullptr;
  const std::uint8_t* counts = nullptr;
  const std::int64_t* ids = nullptr;
  const std::array<float, 3>* positions = nullptr;
};

SealedMap::SealedMap(const std::filesystem::path& path)
    : content_(std::make_unique<const Content>(path)) {}
SealedMap::~SealedMap() = default;
SealedMap::SealedMap(SealedMap&&) noexcept = default;

const std::shared_ptr<const Encoder>& SealedMap::encoder() const { return content_->encoder; }
std::size_t SealedMap::dim() const { return content_->shape.dim; }
std::size_t SealedMap::size() const { return content_->shape.landmarks; }

std::vector<std::int64_t> SealedMap::ids() const {
  std::vector<std::int64_t> result(size());
  if (content_->ids != nullptr) {
    std::copy_n(content_->ids, size(), result.begin());
  } else {
    std::iota(result.begin(), result.end(), std::int64_t{0});
  }
  return result;
}

std::vector<std::uint8_t> SealedMap::counts(std::span<const std::int64_t> landmarks) const {
  std::vector<std::uint8_t> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) result.push_back(content_->counts[content_->at(id)]);
  return result;
}

void SealedMap::prototypes(std::span<const std::int64_t> landmarks, MatrixView<float> means) const {
  if (means.rows != landmarks.size() || means.columns != dim()) {
    throw std::invalid_argument("means must be landmarks x dim");
  }
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const std::size_t row = content_->at(landmarks[i]);
    for (std::size_t d = 0; d < dim(); ++d) {
      means.row(i)[d] = content_->prototypes[packed_index(row, d, dim())];
    }
  }
}

std::vector<Position> SealedMap::positions(std::span<const std::int64_t> landmarks) const {
  std::vector<Position> result;
  result.reserve(landmarks.size());
  const Position& origin = content_->shape.origin;
  for (const std::int64_t id : landmarks) {
    const std::size_t row = content_->at(id);
    Position p = {NAN, NAN, NAN};
    if (content_->positions != nullptr) {
      for (std::size_t i = 0; i < 3; ++i) p[i] = origin[i] + content_->positions[row][i];
    }
    result.push_back(p);
  }
  return result;
}

void SealedMap::search(Descriptors queries, const SearchOptions& options,
                       MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  std::vector<std::int8_t> codes(queries.rows * dim());
  encoder()->encode(queries, {codes.data(), queries.rows, dim()}, options.threads);
  search_codes({codes.data(), queries.rows, dim()}, options, ids, distances);
}

void SealedMap::search_codes(Codes queries, const SearchOptions& options,
                             MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  protomark::search({content_->prototypes, size(), dim(), content_->ids}, queries, options, ids,
                    distances);
}

}  // namespace protomark
