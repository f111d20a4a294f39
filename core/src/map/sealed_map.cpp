#include "protomark/map_file.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <mutex>
#include <optional>
#include <stdexcept>

#include "base/quantize4.h"
#include "file/container.h"
#include "file/ids.h"
#include "file/journal.h"
#include "file/labels.h"
#include "file/sections.h"
#include "map/position_grid.h"
#include "map/summary_builder.h"
#include "protomark/error.h"
#include "search/coarse_quantizer.h"
#include "search/inverted_lists.h"
#include "search/recall.h"
#include "search/scan.h"

namespace protomark {

void expect_encoder(const Encoder& encoder, const Encoder& expected, const std::string& map) {
  if (encoder.identity() == expected.identity()) return;
  const auto named = [](const Encoder& e) {
    return "'" + e.info().name + "' (identity " + e.identity().substr(0, 12) + ")";
  };
  throw std::invalid_argument(map + ": it was made with encoder " + named(encoder) + ", not with " +
                              named(expected) +
                              ": use the map's own encoder, or build the map with the other");
}

void expect_descriptor(const Encoder& encoder, const std::string& descriptor,
                       const std::string& map) {
  if (encoder.info().descriptor == descriptor) return;
  throw std::invalid_argument(map + ": it is a map of " + encoder.info().descriptor +
                              " descriptors, not of " + descriptor);
}

MapKind map_kind(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  if (file.kind() == FileKind::open_map) return MapKind::open;
  file.expect(FileKind::sealed_map);
  return MapKind::sealed;
}

std::shared_ptr<const Encoder> map_encoder(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  const ContainerReader file(mapped.bytes(), path.string());
  if (file.kind() != FileKind::open_map) file.expect(FileKind::sealed_map);
  return read_encoder(file);
}

std::vector<std::pair<std::string, std::size_t>> file_sections(const std::filesystem::path& path) {
  const MappedFile mapped(path);
  return ContainerReader(mapped.bytes(), path.string()).sections();
}

void verify_file(const std::filesystem::path& path) {
  const JournaledFile both(path);
  both.file().verify();
  both.journal().commits(both.file().identity());
}

std::optional<FileJournal> file_journal(const std::filesystem::path& path) {
  const JournaledFile both(path);
  const JournalContent& journal = both.journal();
  if (journal.size() == 0) return std::nullopt;
  return FileJournal{journal.commits(both.file().identity()).size(), journal.size(),
                     journal.torn()};
}

namespace {

constexpr char kRemedy[] = "call build_index before the map is sealed";

}  // namespace

struct SealedMap::Content {
  explicit Content(const std::filesystem::path& path)
      : Content(std::make_unique<MappedFile>(path), path.string()) {
    // Commits that somebody put this map in the way of are not passed over in silence.
    const JournaledFile both(path);
    both.journal().commits(both.file().identity());
  }
  Content(std::unique_ptr<MappedFile> from, const std::string& name)
      : Content(from->bytes(), name) {
    mapped = std::move(from);
  }
  Content(Bytes bytes, const std::string& name) : file(bytes, name) {
    file.expect(FileKind::sealed_map);
    encoder = read_encoder(file);
    shape = read_shape(file, *encoder);
    metadata = read_metadata(file);
    const std::size_t n = shape.landmarks;
    rows = n;
    if (const auto bytes = file.read_if_there(section::kRows)) read_rows();
    std::size_t places = rows;
    if (file.map_if_there(section::kCells)) places = read_index();
    prototypes.rows = places;
    prototypes.dim = shape.dim;
    if (file.map_if_there(section::kLevels)) {
      code_bits = 4;
      prototypes.scale = read_levels(file);
      prototypes.data = map<std::uint8_t>(section::kPrototypes, packed4_size(places, shape.dim));
      if (!indexed()) check_padding();
    } else {
      prototypes.data = map<std::int8_t>(section::kPrototypes, packed_size(places, shape.dim));
    }
    if (indexed()) {
      prototypes.landmarks.look_up = [this](Row row) { return LandmarkIndex{(*order)[row.value]}; };
      prototypes.landmarks.end = {static_cast<std::uint32_t>(n)};
    } else {
      prototypes.landmarks.row_counts = rows_of;
    }
    counts = map<std::uint8_t>(section::kCounts, n);
    ids = LandmarkIds(file, n);
    if (!file.map_if_there(section::kPositions)) return;
    if (file.map_if_there(section::kSteps)) {
      grid = PositionGrid(shape.origin, read_steps(file, shape.origin));
      position_cells = map<PositionGrid::Cell>(section::kPositions, n);
    } else {
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

  // NaN where there is none, or where a broken file has no number.
  Position position(std::size_t landmark) const {
    constexpr Position kNone = {NAN, NAN, NAN};
    if (position_cells != nullptr) return grid.position(position_cells[landmark]);
    if (positions == nullptr) return kNone;
    Position p = shape.origin;
    for (std::size_t i = 0; i < 3; ++i) p[i] += positions[landmark][i];
    return std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]) ? p : kNone;
  }

  void read_rows() {
    const std::size_t n = shape.landmarks;
    rows_of = map<std::uint8_t>(section::kRows, n);
    rows = count_rows(file, std::span(rows_of, n));
    std::uint32_t row = 0;
    for (std::size_t i = 0; i < n; ++i) {
      if (i % kFirstRowsStep == 0) first_rows.push_back(row);
      row += rows_of[i];
    }
  }

  // Cells, and the places of their rows, of which there are as many as this returns.
  std::size_t read_index() {
    centroids = read_cells(file, shape.dim);
    const std::size_t cells = centroids.size() / shape.dim;
    packed_centroids = pack_codes({centroids.data(), cells, shape.dim});
    file.read(section::kCellRows);  // for its checksum
    cell_rows = {map<std::uint32_t>(section::kCellRows, cells), cells};
    first_blocks.push_back(0);
    std::uint64_t all = 0;
    for (const std::uint32_t n : cell_rows) {
      all += n;
      if (all > rows) break;
      first_blocks.push_back(
          first_blocks.back() +
          static_cast<std::uint32_t>((std::uint64_t{n} + kPackedRows - 1) / kPackedRows));
    }
    if (all != rows) file.fail("its cells do not have as many prototypes as the map");
    const std::size_t places = std::size_t{first_blocks.back()} * kPackedRows;
    // Numbers of landmarks and, for padding, the next one.
    order = std::make_unique<const OrderNumbers>(
        file, places, std::bit_width(std::max<std::size_t>(shape.landmarks, 1)));
    const auto bytes = file.read(section::kProbes);
    ranks.resize(bytes.size() / sizeof(std::uint32_t));
    SectionReader(file, section::kProbes).copy(ranks.data(), ranks.size());
    if (bytes.size() % sizeof(std::uint32_t) != 0 || ranks.size() > kTestQueries ||
        !std::is_sorted(ranks.begin(), ranks.end()) ||
        (!ranks.empty() && (ranks.front() < 1 || ranks.back() > cells))) {
      file.fail("its section 'probes' is impossible");
    }
    return places;
  }

  bool indexed() const { return !centroids.empty(); }
  std::size_t index_cells() const { return cell_rows.size(); }

  // The place of a row. With an index places are looked for once, in all of the order.
  std::size_t place(std::size_t row) const {
    if (!indexed()) return row;
    std::call_once(places_found, [&] {
      std::vector<std::uint32_t> found(rows), taken(shape.landmarks, 0);
      const std::size_t all = std::size_t{first_blocks.back()} * kPackedRows;
      std::size_t total = 0;
      for (std::size_t p = 0; p < all; ++p) {
        const std::uint32_t landmark = (*order)[p];
        if (landmark >= shape.landmarks) continue;
        const auto [first, end] = rows_at(landmark);
        if (first + taken[landmark] == end) file.fail("its order names a landmark too often");
        found[first + taken[landmark]++] = static_cast<std::uint32_t>(p);
        ++total;
      }
      if (total != rows) file.fail("its order lacks landmarks");
      places = std::move(found);
    });
    return places[row];
  }

  // The rows of landmark i: the first one and the one behind the last.
  std::pair<std::size_t, std::size_t> rows_at(std::size_t i) const {
    if (rows_of == nullptr) return {i, i + 1};
    std::size_t first = first_rows[i / kFirstRowsStep];
    for (std::size_t j = i / kFirstRowsStep * kFirstRowsStep; j < i; ++j) first += rows_of[j];
    return {first, first + rows_of[i]};
  }

  // That of the last block, where the padding of rows is; padding elsewhere is never looked at.
  void check_padding() const {
    const std::size_t n = rows, dim = shape.dim;
    const std::size_t padded_dim = (dim + 7) / 8 * 8;
    const std::size_t first = n == 0 ? 0 : (n - 1) / kPackedRows * kPackedRows;
    const std::size_t end = n == 0 ? 0 : first + kPackedRows;
    for (std::size_t row = first; row < end; ++row) {
      for (std::size_t d = row < n ? dim : 0; d < padded_dim; ++d) {
        if (value4(row, d) != 0) file.fail("the padding of its prototypes is not zero");
      }
    }
  }

  std::uint8_t value4(std::size_t row, std::size_t d) const {
    const auto* bytes = static_cast<const std::uint8_t*>(prototypes.data);
    const std::uint8_t byte = bytes[packed4_index(row, d, shape.dim)];
    return static_cast<std::uint8_t>(packed4_high(d) ? byte >> 4 : byte & 15);
  }

  int prototype(std::size_t row, std::size_t d) const {
    if (code_bits == 4) return level4(value4(place(row), d), prototypes.scale);
    return static_cast<const std::int8_t*>(prototypes.data)[packed_index(place(row), d, shape.dim)];
  }

  // Landmarks whose first rows are remembered: every one of these.
  static constexpr std::size_t kFirstRowsStep = 64;

  std::unique_ptr<MappedFile> mapped;  // nullptr: the bytes are the caller's
  ContainerReader file;
  std::shared_ptr<const Encoder> encoder;
  MapShape shape;
  Metadata metadata;
  std::size_t rows = 0;                   // prototypes
  const std::uint8_t* rows_of = nullptr;  // of each landmark; nullptr: each has one
  std::vector<std::uint32_t> first_rows;
  int code_bits = 8;
  PackedPrototypes prototypes;
  // The index, or nothing.
  std::vector<std::int8_t> centroids;
  std::vector<CodeVector> packed_centroids;
  std::span<const std::uint32_t> cell_rows;
  std::vector<std::uint32_t> first_blocks;    // of each cell, and the end
  std::unique_ptr<const OrderNumbers> order;  // landmark of each place
  RecallTable ranks;
  mutable std::once_flag places_found;
  mutable std::vector<std::uint32_t> places;  // of each row

  const std::uint8_t* counts = nullptr;
  LandmarkIds ids;
  const std::array<float, 3>* positions = nullptr;
  const PositionGrid::Cell* position_cells = nullptr;  // and with them
  PositionGrid grid;
};

SealedMap::SealedMap(const std::filesystem::path& path)
    : content_(std::make_unique<const Content>(path)) {}
SealedMap::SealedMap(std::span<const std::byte> bytes, const std::string& name) {
  if (reinterpret_cast<std::uintptr_t>(bytes.data()) % 64 != 0) {
    throw std::invalid_argument("the bytes of a map must stand at a multiple of 64");
  }
  content_ = std::make_unique<const Content>(bytes, name);
}
SealedMap::~SealedMap() = default;
SealedMap::SealedMap(SealedMap&&) noexcept = default;

const std::shared_ptr<const Encoder>& SealedMap::encoder() const { return content_->encoder; }
const Metadata& SealedMap::metadata() const { return content_->metadata; }
std::size_t SealedMap::dim() const { return content_->shape.dim; }
std::size_t SealedMap::size() const { return content_->shape.landmarks; }
std::size_t SealedMap::prototype_count() const { return content_->rows; }
int SealedMap::code_bits() const { return content_->code_bits; }

std::size_t SealedMap::index_cells() const { return content_->index_cells(); }

std::size_t SealedMap::probes(double recall) const {
  check_recall(recall, index_cells(), kRemedy);
  return nprobe_for(content_->ranks, recall, index_cells());
}

int SealedMap::position_bits() const {
  return content_->position_cells != nullptr ? 16 : content_->positions != nullptr ? 32 : 0;
}

std::optional<Position> SealedMap::position_error() const {
  if (content_->position_cells == nullptr) return std::nullopt;
  const Position& step = content_->grid.step;
  return Position{step[0] / 2, step[1] / 2, step[2] / 2};
}

std::vector<std::int64_t> SealedMap::ids() const { return content_->ids.all(); }

std::vector<std::uint32_t> SealedMap::counts(std::span<const std::int64_t> landmarks) const {
  std::vector<std::uint32_t> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) {
    result.push_back(content_->counts[content_->ids.find(id)]);
  }
  return result;
}

void SealedMap::prototypes(std::span<const std::int64_t> landmarks, MatrixView<float> means) const {
  if (means.rows != landmarks.size() || means.columns != dim()) {
    throw std::invalid_argument("means must be landmarks x dim");
  }
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const auto [first, end] = content_->rows_at(content_->ids.find(landmarks[i]));
    for (std::size_t d = 0; d < dim(); ++d) {
      int sum = 0;
      for (std::size_t row = first; row < end; ++row) sum += content_->prototype(row, d);
      means.row(i)[d] = static_cast<float>(sum) / static_cast<float>(end - first);
    }
  }
}

std::vector<std::vector<float>> SealedMap::looks(std::int64_t landmark) const {
  const auto [first, end] = content_->rows_at(content_->ids.find(landmark));
  std::vector<std::vector<float>> result;
  for (std::size_t row = first; row < end; ++row) {
    std::vector<float>& look = result.emplace_back(dim());
    for (std::size_t d = 0; d < dim(); ++d) {
      look[d] = static_cast<float>(content_->prototype(row, d));
    }
  }
  return result;
}

std::vector<Position> SealedMap::positions(std::span<const std::int64_t> landmarks) const {
  std::vector<Position> result;
  result.reserve(landmarks.size());
  for (const std::int64_t id : landmarks) {
    result.push_back(content_->position(content_->ids.find(id)));
  }
  return result;
}

MapSummary SealedMap::summary() const {
  SummaryBuilder result;
  for (std::size_t i = 0; i < size(); ++i) result.add(content_->counts[i], content_->position(i));
  return result.take();
}

void SealedMap::search(Descriptors queries, const SearchOptions& options,
                       MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) const {
  std::vector<std::int8_t> codes(queries.rows * dim());
  encoder()->encode(queries, {codes.data(), queries.rows, dim()}, options.threads);
  search_codes({codes.data(), queries.rows, dim()}, options, ids, distances);
}

void SealedMap::search_codes(Codes queries, const SearchOptions& options,
                             MatrixView<std::int64_t> ids,
                             MatrixView<std::int32_t> distances) const {
  const Content& c = *content_;
  auto nprobe = requested_nprobe(options, c.index_cells(), kRemedy);
  if (options.recall) nprobe = probes(*options.recall);
  if (nprobe) {
    search_lists(c.prototypes, InvertedLists(c.cell_rows, c.first_blocks),
                 {c.packed_centroids.data(), c.index_cells(), dim()}, *nprobe, queries, options,
                 ids, distances);
  } else {
    search_exact(c.prototypes, queries, options, ids, distances);
  }
  // Ids ascend as numbers do, so that these decide between equals as ids would.
  if (c.ids.are_numbers()) return;
  for (std::int64_t& id : std::span(ids.data, ids.rows * ids.columns)) {
    if (id >= 0) id = c.ids[static_cast<std::size_t>(id)];
  }
}

}  // namespace protomark
