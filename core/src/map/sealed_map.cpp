#include "protomark/sealed_map.h"

#include "encoder/codebooks.h"
#include "file/ids.h"
#include "file/journal.h"
#include "map/map_sections.h"
#include "map/sealed_store.h"
#include "search/inverted_lists.h"

namespace protomark {

constexpr char kRemedy[] = "call build_index before the map is sealed";

struct SealedMap::Content {
  Content(Bytes bytes, const std::string& name, std::unique_ptr<MappedFile> from = nullptr)
      : mapped(std::move(from)), file(bytes, name) {
    file.expect(FileKind::sealed_map);
    encoder = read_encoder(file);
    shape = read_shape(file, *encoder);
    metadata = read_metadata(file);
    const size_t n = shape.landmarks;
    prototype_count = n;
    if (file.has(section::kRows)) read_row_counts();
    prototypes.rows = prototype_count;
    prototypes.dim = shape.dim;
    if (file.has(section::kCentroids)) read_index();
    if (owners != nullptr || !row_counts.empty()) {
      prototypes.landmarks.look_up = [this](Row row) { return owner(row); };
      prototypes.landmarks.end = landmark_at(n);
    }
    if (file.has(section::kWidth)) read_codebook();
    const size_t size = packed_size(prototypes.rows, shape.dim, prototypes.width);
    prototypes.data = file.map<std::byte>(section::kPrototypes, size).data();
    ids = LandmarkIds(file, n);
    if (!file.has(section::kPositions)) return;
    codec.emplace(file, shape.origin);
    positions = file.map<std::byte>(section::kPositions, n * codec->size());
  }

  void read_codebook() {
    const size_t width = read_value<uint32_t>(file, section::kWidth);
    const auto& codebooks = encoder->codebooks();
    const auto codebook = std::ranges::find(codebooks, width, &Codebook::width);
    file.require(codebook != codebooks.end() && codebook->covers(shape.dim),
                 "its encoder has no codebook for words of ", width, " numbers of ", shape.dim);
    table = decode_table(*codebook, shape.dim);
    prototypes.width = width;
    prototypes.table = table.data();
  }

  void read_row_counts() {
    row_counts = file.read<uint8_t>(section::kRows, shape.landmarks);
    prototype_count = 0;
    for (size_t i = 0; i < row_counts.size(); ++i) {
      file.require(row_counts[i] != 0, "it has a landmark without prototypes");
      if (i % kFirstRowStep == 0) first_rows.push_back(static_cast<uint32_t>(prototype_count));
      prototype_count += row_counts[i];
    }
    file.require(prototype_count <= UINT32_MAX, "it claims more prototypes than a map can hold");
  }

  // Reads the inverted lists, which tell how many rows there are, padding included.
  void read_index() {
    const Matrix<int8_t> centroids = read_centroids(file, shape.dim);
    const size_t lists = centroids.rows;
    packed_centroids = pack_codes(centroids);
    list_rows = file.read<uint32_t>(section::kListRows, lists);
    first_blocks.push_back(0);
    uint64_t total = 0;
    for (const uint64_t n : list_rows) {
      total += n;
      if (total > prototype_count) break;
      first_blocks.push_back(first_blocks.back() + static_cast<uint32_t>(packed_blocks(n)));
    }
    file.require(total == prototype_count, "its lists do not have as many prototypes as the map");
    prototypes.rows = size_t{first_blocks.back()} * kPackedRows;
    const int bits = owner_bits(shape.landmarks);
    const auto words = file.map<uint64_t>(section::kOwners, packed_words(prototypes.rows, bits));
    owners = std::make_unique<const CheckedNumbers>(
        words, bits,
        file.read<uint32_t>(section::kOwnerChecksums, CheckedNumbers::blocks(words.size())),
        file.name() + ": its section '" + section::kOwners + "'");
    recall_table = read_section<uint32_t>(file, section::kRecall);
    file.require(
        recall_table.size() <= kTestQueries && std::ranges::is_sorted(recall_table) &&
            (recall_table.empty() || (recall_table.front() >= 1 && recall_table.back() <= lists)),
        "its recall table is impossible");
  }

  size_t words() const { return prototypes.width == 0 ? 0 : shape.dim / prototypes.width; }
  // Returns the landmark of a row where indices differ. Throws FileError if owners are broken.
  LandmarkIndex owner(Row row) const {
    if (owners != nullptr) return landmark_at((*owners)[row.value]);
    const auto after = std::ranges::upper_bound(first_rows, row.value);
    auto landmark = static_cast<size_t>(after - first_rows.begin() - 1) * kFirstRowStep;
    for (size_t end = *(after - 1) + row_counts[landmark]; end <= row.value;) {
      end += row_counts[++landmark];
    }
    return landmark_at(landmark);
  }

  size_t nlist() const { return list_rows.size(); }

  Position position(LandmarkIndex landmark) const {
    return codec ? codec->decode(&positions[landmark.value * codec->size()]) : kNoPosition;
  }

  // Returns the first prototype of a landmark and the one after its last, counted by id.
  std::pair<size_t, size_t> prototypes_of(LandmarkIndex landmark) const {
    const size_t i = landmark.value;
    if (row_counts.empty()) return {i, i + 1};
    size_t first = first_rows[i / kFirstRowStep];
    for (size_t j = i / kFirstRowStep * kFirstRowStep; j < i; ++j) first += row_counts[j];
    return {first, first + row_counts[i]};
  }

  // Appends the rows of a landmark. With an index, the owners of all rows are read once.
  void append_rows(LandmarkIndex landmark, std::vector<Row>& to) const {
    const auto [first, end] = prototypes_of(landmark);
    if (nlist() != 0) find_rows();
    for (size_t i = first; i < end; ++i) to.push_back(nlist() == 0 ? row_at(i) : rows[i]);
  }
  void find_rows() const {
    std::call_once(rows_found, [&] {
      std::vector<Row> found(prototype_count);
      std::vector<uint32_t> taken(shape.landmarks, 0);
      size_t total = 0;
      for (Row row{0}; row.value < prototypes.rows; ++row.value) {
        const LandmarkIndex landmark = owner(row);
        if (landmark.value >= shape.landmarks) continue;
        const auto [first, last] = prototypes_of(landmark);
        const size_t at = first + taken[landmark.value]++;
        file.require(at != last, "it has more prototypes of a landmark than it counts");
        found[at] = row;
        ++total;
      }
      file.require(total == prototype_count, "it lacks prototypes of a landmark");
      rows = std::move(found);
    });
  }

  std::vector<Row> rows_of(int64_t id) const {
    std::vector<Row> result;
    append_rows(ids.find(id), result);
    return result;
  }
  void write_mean(std::span<const Row> of, float* mean) const {
    for (size_t d = 0; d < shape.dim; ++d) {
      int sum = 0;
      for (const Row row : of) sum += value(row, d);
      mean[d] = static_cast<float>(sum) / static_cast<float>(of.size());
    }
  }
  int value(Row row, size_t d) const {
    const auto* data = static_cast<const int8_t*>(prototypes.data);
    if (words() == 0) return data[packed_index(row.value, d, shape.dim)];
    const int8_t word = data[word_index(row.value, d / prototypes.width, words())];
    return table[d * Codebook::kWords + static_cast<uint8_t>(word)];
  }

  static constexpr size_t kFirstRowStep = 16;  // landmarks

  std::unique_ptr<MappedFile> mapped;  // nullptr if the caller keeps the bytes
  ContainerReader file;
  std::shared_ptr<const Encoder> encoder;
  MapShape shape;
  Metadata metadata;
  size_t prototype_count = 0;
  std::span<const uint8_t> row_counts;  // empty if each landmark has one row
  std::vector<uint32_t> first_rows;     // of every kFirstRowStep-th landmark
  PackedPrototypes prototypes;
  std::vector<int8_t> table;  // of a codebook, if there are words
  // With an index.
  std::vector<CodeVector> packed_centroids;
  std::span<const uint32_t> list_rows;
  std::vector<uint32_t> first_blocks;            // of each list, and the end
  std::unique_ptr<const CheckedNumbers> owners;  // of each row
  RecallTable recall_table;
  mutable std::once_flag rows_found;
  mutable std::vector<Row> rows;  // of prototypes by id

  LandmarkIds ids;
  std::optional<PositionCodec> codec;
  std::span<const std::byte> positions;
};

SealedMap::SealedMap(const std::filesystem::path& path) {
  auto mapped = std::make_unique<MappedFile>(path);
  const Bytes bytes = mapped->bytes();
  content_ = std::make_unique<const Content>(bytes, path.string(), std::move(mapped));
  // Refuses a map file that replaced one with commits.
  const JournaledFile both(path);
  both.journal.commits(both.file->identity());
}
SealedMap::SealedMap(std::span<const std::byte> bytes, const std::string& name) {
  require(reinterpret_cast<std::uintptr_t>(bytes.data()) % kSectionAlignment == 0,
          "the bytes of a map must begin at a multiple of ", kSectionAlignment, " in memory");
  content_ = std::make_unique<const Content>(bytes, name);
}
SealedMap::SealedMap(SealedMap&&) noexcept = default;
SealedMap::~SealedMap() = default;

// What was checked when the map was opened need not hold for other bytes.
const SealedMap::Content& SealedMap::unchanged() const {
  content_->file.require(
      !content_->mapped || content_->mapped->unchanged(),
      "it was written to while it was open: open it again, and replace map files by renaming, not "
      "by cp, scp or rsync --inplace");
  return *content_;
}

const std::shared_ptr<const Encoder>& SealedMap::encoder() const { return content_->encoder; }
const Metadata& SealedMap::metadata() const { return content_->metadata; }
size_t SealedMap::dim() const { return content_->shape.dim; }
size_t SealedMap::size() const { return content_->shape.landmarks; }
size_t SealedMap::prototype_count() const { return content_->prototype_count; }
size_t SealedMap::words() const { return content_->words(); }
bool SealedMap::tuned() const { return content_->file.has(section::kTuned); }
size_t SealedMap::nlist() const { return content_->nlist(); }
std::vector<int64_t> SealedMap::ids() const { return unchanged().ids.all(); }

double SealedMap::bytes_per_landmark() const {
  if (size() == 0) return 0;
  const size_t row_bytes = words() == 0 ? packed_dim(dim()) : words();
  return static_cast<double>(sealed_bytes(size(), prototype_count(), row_bytes)) /
         static_cast<double>(size());
}

size_t SealedMap::nprobe(double recall) const {
  check_recall(recall, nlist(), kRemedy);
  return nprobe_for(content_->recall_table, recall, nlist());
}

int SealedMap::position_bits() const { return content_->codec ? content_->codec->bits() : 0; }

std::optional<Position> SealedMap::position_error() const {
  if (position_bits() != 16) return std::nullopt;
  const Position& step = content_->codec->step();
  return Position{step[0] / 2, step[1] / 2, step[2] / 2};
}

Matrix<float> SealedMap::prototypes(std::span<const int64_t> landmark_ids) const {
  const Content& c = unchanged();
  Matrix<float> means(landmark_ids.size(), dim());
  for (size_t i = 0; i < landmark_ids.size(); ++i) {
    c.write_mean(c.rows_of(landmark_ids[i]), means.row(i));
  }
  return means;
}

Matrix<float> SealedMap::appearances(int64_t id) const {
  const Content& c = unchanged();
  const std::vector<Row> rows = c.rows_of(id);
  Matrix<float> result(rows.size(), dim());
  for (size_t i = 0; i < rows.size(); ++i) c.write_mean({&rows[i], 1}, result.row(i));
  return result;
}

std::vector<Position> SealedMap::positions(std::span<const int64_t> landmark_ids) const {
  const Content& c = unchanged();
  std::vector<Position> result;
  for (const int64_t id : landmark_ids) result.push_back(c.position(c.ids.find(id)));
  return result;
}

MapSummary SealedMap::summary() const {
  const Content& c = unchanged();
  MapSummary result;
  for (size_t i = 0; i < size(); ++i) add_to_summary(result, c.position(landmark_at(i)));
  return result;
}

Matches SealedMap::search_codes(Codes queries, size_t k, const SearchOptions& options) const {
  const Content& c = unchanged();
  check_lists(options, nlist(), kRemedy);
  const size_t lists = options.recall ? nprobe(*options.recall) : options.nprobe.value_or(SIZE_MAX);
  const auto append = [&](LandmarkIndex landmark, std::vector<Row>& rows) {
    c.append_rows(landmark, rows);
  };
  const LandmarkRows landmarks{size(), [&](auto id) { return c.ids.find(id); }, append};
  Matches matches = search_map(c.prototypes, InvertedLists(c.list_rows, c.first_blocks),
                               {c.packed_centroids.data(), nlist(), dim()}, landmarks, lists,
                               queries, k, options);
  // Search returns landmark indices, with which ids ascend, so that ties went to the smaller id.
  if (c.ids.are_indices()) return matches;
  for (int64_t& id : matches.ids.data) {
    if (id >= 0) id = c.ids[landmark_at(static_cast<size_t>(id))];
  }
  return matches;
}

}  // namespace protomark
