// Seals a learning map, producing sections while they are written, in little memory.
#include "encoder/codebooks.h"
#include "file/ids.h"
#include "map/map_sections.h"
#include "map/map_state.h"
#include "map/sealed_store.h"
#include "map/tuning.h"
#include "search/scan.h"

namespace protomark {
namespace {

using Sink = ContainerWriter::Sink;
using Sinks = std::span<const Sink>;

// Packs blocks of kPackedRows rows as search reads them.
class BlockPacker {
 public:
  // Rows are words of the codebook, or int8 numbers if there is none.
  BlockPacker(const PrototypeStore& store, const Codebook* codebook) : store_(&store) {
    if (codebook == nullptr) return;
    width_ = codebook->width;
    nearest_.emplace(*codebook, store.dim());
    table_ = decode_table(*codebook, store.dim());
  }

  // Bytes per block.
  size_t size() const { return packed_size(kPackedRows, store_->dim(), width_); }
  // Returns how packed rows are read, but for which they are.
  PackedPrototypes view() const {
    PackedPrototypes result = store_->view();
    result.width = width_;
    result.table = table_.data();
    return result;
  }
  // Replaces a code by the one that it is stored as.
  void quantize(int8_t* code) const {
    if (!nearest_) return;
    std::array<uint8_t, 256> words;
    nearest_->find(code, 0, 1, words.data());
    for (size_t d = 0; d < store_->dim(); ++d) {
      code[d] = table_[d * Codebook::kWords + words[d / width_]];
    }
  }

  // `rows` are kPackedRows, kNoRow for padding.
  void pack(const Row* rows, uint8_t* to) const {
    const size_t dim = store_->dim();
    std::array<int8_t, 256 * kPackedRows> codes{};
    for (size_t i = 0; i < kPackedRows; ++i) {
      if (rows[i] != kNoRow) store_->rounded(rows[i], &codes[i * dim]);
    }
    if (nearest_) {
      nearest_->find(codes.data(), dim, kPackedRows, to);
      for (size_t i = 0; i < size(); ++i) {
        if (rows[i % kPackedRows] == kNoRow) to[i] = 0;
      }
      return;
    }
    std::fill_n(to, size(), uint8_t{0});
    for (size_t i = 0; i < kPackedRows; ++i) {
      for (size_t d = 0; d < dim; d += 4) {
        std::memcpy(to + packed_index(i, d, dim), &codes[i * dim + d],
                    std::min<size_t>(4, dim - d));
      }
    }
  }

 private:
  const PrototypeStore* store_;
  size_t width_ = 0;
  std::optional<NearestWords> nearest_;
  std::vector<int8_t> table_;
};

// Maps landmarks of a store to those of a sealed map, in little more than a byte per landmark: the
// id tells the block of 256.
class SealedLandmarks {
 public:
  explicit SealedLandmarks(const PrototypeStore& store)
      : store_(&store), in_block_(store.ids().size()) {}

  // Landmarks come by ascending id.
  void add(LandmarkIndex landmark) {
    if (added_ % kBlock == 0) first_ids_.push_back(store_->id(landmark));
    in_block_[landmark.value] = static_cast<uint8_t>(added_++ % kBlock);
  }

  size_t operator[](LandmarkIndex landmark) const {
    const auto next = std::ranges::upper_bound(first_ids_, store_->id(landmark));
    const auto block = static_cast<size_t>(next - first_ids_.begin()) - 1;
    return block * kBlock + in_block_[landmark.value];
  }

 private:
  static constexpr size_t kBlock = 256;

  const PrototypeStore* store_;
  std::vector<uint8_t> in_block_;  // the index of a landmark in its block
  std::vector<int64_t> first_ids_;
  size_t added_ = 0;
};

// Writes rows, each list beginning a new block, and their owners if there is a writer for these.
class RowWriter {
 public:
  RowWriter(const BlockPacker& packer, size_t landmarks, const Sink& prototypes,
            PackedWriter* owners = nullptr)
      : packer_(packer), landmarks_(landmarks), prototypes_(prototypes), owners_(owners) {}

  void add(Row row, size_t owner = 0) {
    block_[filled_++] = row;
    if (owners_ != nullptr) owners_->add(owner, owner_bits(landmarks_));
    if (filled_ < kPackedRows) return;
    packed_.resize(packed_.size() + packer_.size());
    packer_.pack(block_.data(), packed_.data() + packed_.size() - packer_.size());
    filled_ = 0;
    if (packed_.size() >= kPiece) flush();
  }
  void end_list() {
    while (filled_ != 0) add(kNoRow, landmarks_);
  }
  void flush() {
    prototypes_(std::as_bytes(std::span(packed_)));
    packed_.clear();
  }

 private:
  static constexpr size_t kPiece = 1 << 16;  // bytes

  const BlockPacker& packer_;
  size_t landmarks_;
  const Sink& prototypes_;
  PackedWriter* owners_;
  std::array<Row, kPackedRows> block_{};
  size_t filled_ = 0;
  std::vector<uint8_t> packed_;
};

// Finds the two nearest landmarks of each query among packed prototypes, which it packs piece by
// piece.
Matches search_packed(const PrototypeStore& store, const BlockPacker& packer, Codes queries,
                      size_t k) {
  // A piece is small compared with the map.
  const size_t size = std::max<size_t>(1 << 12, store.prototype_count() / 64 / 16 * 16);
  std::vector<CodeVector> packed(size * packer.size() / kPackedRows / sizeof(CodeVector) + 1);
  std::array<Row, kPackedRows> block;
  const PreparedCodes prepared(queries);
  Neighbours nearest = prepared.neighbours(k, {});
  PackedPrototypes piece = packer.view();
  piece.data = packed.data();
  for (size_t first = 0; first < store.row_end(); first += piece.rows) {
    piece.rows = std::min(size, store.row_end() - first);
    auto* to = reinterpret_cast<uint8_t*>(packed.data());
    for (size_t i = 0; i < piece.rows; i += kPackedRows, to += packer.size()) {
      for (size_t j = 0; j < kPackedRows; ++j) block[j] = row_at(first + i + j);
      packer.pack(block.data(), to);
    }
    PrototypeScan(piece, prepared, {0, queries.rows}, nearest).scan({0, piece.rows});
    if (store.several()) {
      piece.landmarks.of_row += piece.rows;
    } else {
      piece.landmarks.ids += piece.rows;
    }
  }
  Matches matches{{queries.rows, k}, {queries.rows, k}};
  write_answer(nearest, prepared.norms(), {}, 0, matches);
  return matches;
}

// Produces the sections of landmarks and rows in one pass over landmarks by id and, with an index,
// another one over its lists.
class SealedContent {
 public:
  // `store` has the prototypes, `map` everything else.
  SealedContent(const PrototypeStore& store, const PrototypeStore& map, const BlockPacker& packer,
                const std::optional<PositionCodec>& codec)
      : store_(store), map_(map), packer_(packer), codec_(codec) {
    int64_t largest = -1;
    for (const int64_t id : store.ids()) largest = std::max(largest, id);
    ids_are_stored_ = IdBlockWriter::needed(store.landmark_count(), largest);
  }

  // Adds the sections to a file that is written while this exists.
  void add_to(ContainerWriter& file) {
    const size_t n = store_.landmark_count(), nlist = store_.quantizer().nlist();
    const ContainerWriter::Part prototypes{section::kPrototypes,
                                           store_.lists().blocks() * packer_.size()};
    std::vector<ContainerWriter::Part> parts;
    if (has_row_counts()) parts.push_back({section::kRows, n});
    if (codec_) parts.push_back({section::kPositions, n * codec_->size()});
    if (nlist == 0) parts.push_back(prototypes);
    if (ids_are_stored_) IdBlockWriter::add_to(parts, n);
    if (!parts.empty()) {
      file.add_together(std::move(parts), [this](Sinks sinks) { put_landmarks(sinks); });
    }
    if (nlist == 0) return;
    const size_t words = packed_words(store_.row_end(), owner_bits(n));
    file.add_together({prototypes, {section::kOwners, packed_bytes(words, 64)}},
                      [this](Sinks sinks) { put_lists(sinks); });
    file.add(section::kOwnerChecksums, CheckedNumbers::blocks(words) * sizeof(uint32_t),
             [this](const Sink& sink) { sink(std::as_bytes(std::span(owner_checksums_))); });
    file.add(section::kCentroids, std::as_bytes(std::span(store_.quantizer().centroids())));
    file.add(section::kListRows, nlist * sizeof(uint32_t), [this, nlist](const Sink& sink) {
      put_values<uint32_t>(sink, nlist, 1, [&](size_t list, uint32_t* to) {
        *to = static_cast<uint32_t>(store_.lists().rows(static_cast<uint32_t>(list)));
      });
    });
    file.add(section::kRecall, ContainerWriter::kUnknownSize, [this](const Sink& sink) {
      const RecallTable table = measure_recall_of(
          store_, [this](int8_t* code) { packer_.quantize(code); },
          [this](Codes queries, size_t k) { return search_packed(store_, packer_, queries, k); });
      sink(std::as_bytes(std::span(table)));
    });
  }

 private:
  bool has_row_counts() const { return store_.prototype_count() != store_.landmark_count(); }

  void put_landmarks(Sinks sinks) {
    auto sink = sinks.begin();
    const Sink* row_counts = has_row_counts() ? &*sink++ : nullptr;
    const Sink* positions = codec_ ? &*sink++ : nullptr;
    std::optional<RowWriter> prototypes;
    if (store_.quantizer().nlist() == 0) {
      prototypes.emplace(packer_, store_.landmark_count(), *sink++);
    }
    std::optional<IdBlockWriter> ids;
    if (ids_are_stored_) ids.emplace(sink[0], sink[1]);
    if (!prototypes && ids_are_stored_) landmarks_.emplace(store_);
    store_.visit_sorted_landmarks([&](std::span<const LandmarkIndex> landmarks) {
      if (row_counts != nullptr) {
        put_each<uint8_t>(*row_counts, landmarks, [&](LandmarkIndex l) {
          return static_cast<uint8_t>(store_.row_count(l));
        });
      }
      if (positions != nullptr) {
        put_values<std::byte>(*positions, landmarks.size(), codec_->size(), [&](auto i, auto* to) {
          const LandmarkIndex l = landmarks[i];
          codec_->encode(map_.position(&store_ == &map_ ? l : map_.at(store_.id(l))), to);
        });
      }
      for (const LandmarkIndex landmark : landmarks) {
        if (ids) ids->add(store_.id(landmark));
        if (landmarks_) landmarks_->add(landmark);
      }
      if (!prototypes) return;
      for (const Row row : store_.sorted_rows(landmarks)) prototypes->add(row);
    });
    if (ids) ids->finish();
    if (!prototypes) return;
    prototypes->end_list();
    prototypes->flush();
  }

  void put_lists(Sinks sinks) {
    owner_checksums_.clear();
    // Comes in pieces of whole blocks.
    PackedWriter owners([&](Bytes bytes) {
      constexpr size_t kBlock = CheckedNumbers::kBlock * sizeof(uint64_t);
      for (size_t at = 0; at < bytes.size(); at += kBlock) {
        owner_checksums_.push_back(crc32(bytes.subspan(at, std::min(kBlock, bytes.size() - at))));
      }
      sinks[1](bytes);
    });
    RowWriter writer(packer_, store_.landmark_count(), sinks[0], &owners);
    for (uint32_t list = 0; list < store_.quantizer().nlist(); ++list) {
      store_.visit_sorted_rows(list, [&](std::span<const Row> rows) {
        for (const Row row : rows) {
          const LandmarkIndex owner = store_.owner(row);
          writer.add(row,
                     landmarks_ ? (*landmarks_)[owner] : static_cast<size_t>(store_.id(owner)));
        }
      });
      writer.end_list();
    }
    writer.flush();
    owners.finish();
    landmarks_.reset();  // makes room for the test queries
  }

  const PrototypeStore &store_, &map_;
  const BlockPacker& packer_;
  const std::optional<PositionCodec>& codec_;
  bool ids_are_stored_;
  std::optional<SealedLandmarks> landmarks_;  // with an index, if ids are stored
  std::vector<uint32_t> owner_checksums_;
};

}  // namespace

void PrototypeMap::seal(const std::filesystem::path& path, const SealOptions& options,
                        std::span<const int64_t> ids, Descriptors descriptors) const {
  check_pairs(ids.size(), descriptors.rows, "descriptors");
  if (ids.empty()) return seal_codes(path, options, {}, {});
  seal_codes(path, options, ids, encoder()->encode(descriptors, dim(), options.threads));
}

void PrototypeMap::seal_codes(const std::filesystem::path& path, const SealOptions& options,
                              std::span<const int64_t> ids, Codes codes) const {
  if (options.position_bits != 32 && options.position_bits != 16 && options.position_bits != 0) {
    invalid("position_bits must be 32, 16 or 0, not ", options.position_bits);
  }
  check_pairs(ids.size(), codes.rows, "codes");
  if (codes.rows != 0) check_codes(codes, dim());
  const std::shared_lock lock(state_->changing);
  const PrototypeStore& map = state_->store;
  const SealFormat format =
      seal_format(map, *encoder(), options.bytes_per_landmark, options.tune && !ids.empty());
  auto changed = merge_appearances(map, format.dim, format.row_limit);
  // Appearances that remain say no more of what they are mistaken for.
  const bool merged =
      map.several() && changed && changed->prototype_count() == map.landmark_count();
  const bool tuned = options.tune && options.bytes_per_landmark && (merged || !ids.empty());
  if (tuned) {
    const TuningQueries queries =
        ids.empty() ? TuningQueries(map, format.dim) : TuningQueries(ids, codes, format.dim);
    changed.emplace(tune_prototypes(changed ? *changed : map, queries, options.threads));
  }
  const PrototypeStore& store = changed ? *changed : map;
  std::optional<PositionCodec> codec;
  if (options.position_bits != 0) {
    if (const auto extent = map.summary().extent) codec.emplace(*extent, options.position_bits);
  }

  ContainerWriter file(FileKind::sealed_map);
  file.add(section::kEncoder, encoder()->serialize());
  add_value(file, section::kShape,
            MapShape{map.landmark_count(), format.dim, codec ? codec->origin() : Position{}});
  add_metadata(file, state_->metadata);
  if (format.codebook != nullptr) {
    add_value(file, section::kWidth, static_cast<uint32_t>(format.codebook->width));
  }
  if (tuned) add_value(file, section::kTuned, uint32_t{1});
  if (codec && codec->bits() == 16) add_value(file, section::kSteps, codec->step());
  const BlockPacker packer(store, format.codebook);
  SealedContent content(store, map, packer, codec);
  content.add_to(file);
  write_guarded(file, path);
}

}  // namespace protomark
