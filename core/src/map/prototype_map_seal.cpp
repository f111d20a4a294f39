// Seals a learning map, producing sections while they are written, in little memory.
#include "encoder/codebooks.h"
#include "file/ids.h"
#include "map/map_sections.h"
#include "map/map_state.h"
#include "map/sealed_store.h"
#include "search/scan.h"

namespace protomark {
namespace {

using Writers = ContainerWriter::Writers;

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
    std::fill_n(to, size(), uint8_t{0});
    for (size_t i = 0; i < kPackedRows; ++i) {
      if (rows[i] == kNoRow) continue;
      nearest_ ? store_->rounded(rows[i], &codes[i * dim]) : store_->copy_packed(rows[i], to, i);
    }
    if (!nearest_) return;
    nearest_->find(codes.data(), dim, kPackedRows, to);
    for (size_t i = 0; i < size(); ++i) {
      if (rows[i % kPackedRows] == kNoRow) to[i] = 0;
    }
  }

 private:
  const PrototypeStore* store_;
  size_t width_ = 0;
  std::optional<NearestWords> nearest_;
  std::vector<int8_t> table_;
};

// Finds the two nearest landmarks of each query among prototypes that are packed piece by piece.
Matches search_packed(const PrototypeStore& store, const BlockPacker& packer, Codes queries) {
  // A piece is small compared with the map.
  const size_t size = std::max<size_t>(1 << 12, store.prototype_count() / 64 / 16 * 16);
  std::vector<CodeVector> packed(size * packer.size() / kPackedRows / sizeof(CodeVector) + 1);
  std::array<Row, kPackedRows> block;
  return answer(store.dim(), queries, 2, {}, [&](const auto& prepared, auto& nearest) {
    PackedPrototypes piece = packer.view();
    piece.data = packed.data();
    for (size_t first = 0; first < store.row_end(); first += piece.rows) {
      piece.rows = std::min(size, store.row_end() - first);
      auto* to = reinterpret_cast<uint8_t*>(packed.data());
      for (size_t i = 0; i < piece.rows; i += kPackedRows, to += packer.size()) {
        for (size_t j = 0; j < kPackedRows; ++j) block[j] = row_at(first + i + j);
        packer.pack(block.data(), to);
      }
      scan_all(piece, prepared, 1, nearest);
      if (store.several()) {
        piece.landmarks.of_row += piece.rows;
      } else {
        piece.landmarks.ids += piece.rows;
      }
    }
  });
}

// Produces sections in one pass over landmarks by id and, with an index, one over its lists.
class SealedContent {
 public:
  // `store` has the prototypes, `map` everything else.
  SealedContent(const PrototypeStore& store, const PrototypeStore& map, const BlockPacker& packer,
                const std::optional<PositionCodec>& codec)
      : store_(store), map_(map), packer_(packer), codec_(codec) {}

  // The file must be written while this exists.
  void add_to(ContainerWriter& file) {
    const size_t n = store_.landmark_count(), nlist = store_.quantizer().nlist();
    const ContainerWriter::Part prototypes{section::kPrototypes,
                                           store_.lists().blocks() * packer_.size()};
    std::vector<ContainerWriter::Part> parts;
    if (has_row_counts()) parts.push_back({section::kRows, n});
    if (codec_) parts.push_back({section::kPositions, n * codec_->size()});
    if (nlist == 0) parts.push_back(prototypes);
    if (ids_are_stored_) IdBlockWriter::add_to(parts, n);
    file.add(std::move(parts), [this](Writers& to) { put_landmarks(to); });
    if (nlist == 0) return;
    const size_t words = packed_words(store_.row_end(), owner_bits(n));
    file.add({prototypes, {section::kOwners, packed_bytes(words, 64)}},
             [this](Writers& to) { put_lists(to); });
    file.add({{section::kOwnerChecksums, CheckedNumbers::blocks(words) * sizeof(uint32_t)}},
             [this](Writers& to) {
               to[section::kOwnerChecksums].add_all(std::as_bytes(std::span(owner_checksums_)));
             });
    file.add(section::kCentroids, std::as_bytes(std::span(store_.quantizer().centroids().data)));
    std::vector<uint32_t> list_rows;
    for (uint32_t list = 0; list < nlist; ++list) {
      list_rows.push_back(static_cast<uint32_t>(store_.lists().rows(list)));
    }
    file.add(section::kListRows, std::as_bytes(std::span(list_rows)));
    file.add({{section::kRecall, ContainerWriter::kUnknownSize}}, [this](Writers& to) {
      const RecallTable table = measure_recall(
          store_, [this](int8_t* code) { packer_.quantize(code); },
          [this](Codes queries) { return search_packed(store_, packer_, queries); });
      to[section::kRecall].add_all(std::as_bytes(std::span(table)));
    });
  }

 private:
  bool has_row_counts() const { return store_.prototype_count() != store_.landmark_count(); }

  void put_landmarks(Writers& to) {
    const bool indexed = store_.quantizer().nlist() != 0;
    std::vector<Row> rows;
    IdBlockWriter ids(to);
    if (indexed && ids_are_stored_) in_block_.resize(store_.ids().size());
    first_ids_.clear();
    size_t rank = 0;
    store_.visit_sorted_landmarks([&](std::span<const LandmarkIndex> landmarks) {
      for (const LandmarkIndex l : landmarks) {
        if (has_row_counts()) to[section::kRows].add(static_cast<uint8_t>(store_.row_count(l)));
        if (codec_) {
          codec_->encode(map_.position(&store_ == &map_ ? l : map_.at(store_.id(l))),
                         to[section::kPositions].add_bytes(codec_->size()));
        }
        if (ids_are_stored_) ids.add(store_.id(l));
        if (in_block_.empty()) continue;
        if (rank % kRanks == 0) first_ids_.push_back(store_.id(l));
        in_block_[l.value] = static_cast<uint8_t>(rank++ % kRanks);
      }
      if (indexed) return;
      const std::vector<Row> more = store_.sorted_rows(landmarks);
      rows.insert(rows.end(), more.begin(), more.end());
      put_blocks(rows, to);
    });
    pad(rows);
    put_blocks(rows, to);
    ids.finish();
  }

  void put_lists(Writers& to) {
    owner_checksums_.clear();
    // Comes in pieces of whole blocks.
    ValueWriter owners([&](Bytes bytes) {
      constexpr size_t kBlock = CheckedNumbers::kBlock * sizeof(uint64_t);
      for (size_t at = 0; at < bytes.size(); at += kBlock) {
        owner_checksums_.push_back(crc32(bytes.subspan(at, std::min(kBlock, bytes.size() - at))));
      }
      to[section::kOwners].add_all(bytes);
    });
    const size_t n = store_.landmark_count();
    for (uint32_t list = 0; list < store_.quantizer().nlist(); ++list) {
      std::vector<Row> rows = store_.sorted_rows_of_list(list);
      pad(rows);
      for (const Row row : rows) {
        owners.add(row == kNoRow ? n : rank_of(store_.owner(row)), owner_bits(n));
      }
      put_blocks(rows, to);
    }
    owners.finish();
    in_block_ = {};  // makes room for the test queries
  }

  static void pad(std::vector<Row>& rows) {
    rows.resize(packed_blocks(rows.size()) * kPackedRows, kNoRow);
  }
  // Writes the rows of whole blocks, and removes them.
  void put_blocks(std::vector<Row>& rows, Writers& to) const {
    const size_t n = rows.size() / kPackedRows * kPackedRows;
    for (size_t i = 0; i < n; i += kPackedRows) {
      std::byte* block = to[section::kPrototypes].add_bytes(packer_.size());
      packer_.pack(&rows[i], reinterpret_cast<uint8_t*>(block));
    }
    rows.erase(rows.begin(), rows.begin() + static_cast<std::ptrdiff_t>(n));
  }
  // Returns the rank of a landmark by id, which is its index in the sealed map.
  size_t rank_of(LandmarkIndex landmark) const {
    const int64_t id = store_.id(landmark);
    if (!ids_are_stored_) return static_cast<size_t>(id);
    const auto next = std::ranges::upper_bound(first_ids_, id);
    const auto block = static_cast<size_t>(next - first_ids_.begin()) - 1;
    return block * kRanks + in_block_[landmark.value];
  }

  const PrototypeStore &store_, &map_;
  const BlockPacker& packer_;
  const std::optional<PositionCodec>& codec_;
  const bool ids_are_stored_ =
      !store_.ids().empty() &&
      IdBlockWriter::needed(store_.landmark_count(), *std::ranges::max_element(store_.ids()));
  // With an index, if ids are stored: the first id of each block of landmarks by id, and for each
  // landmark its rank in its block, which take little more than a byte.
  static constexpr size_t kRanks = 256;
  std::vector<int64_t> first_ids_;
  std::vector<uint8_t> in_block_;
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
  const int bits = options.position_bits;
  require(bits == 32 || bits == 16 || bits == 0, "position_bits must be 32, 16 or 0, not ", bits);
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
  if (const auto extent = bits == 0 ? std::nullopt : map.summary().extent) {
    codec.emplace(*extent, bits);
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
