// Seals a learning map. Sections come into being while they are written, so that this takes little
// memory beside the map.
#include <algorithm>
#include <functional>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "file/ids.h"
#include "file/sections.h"
#include "map/map_sections.h"
#include "map/map_state.h"
#include "map/positions.h"
#include "map/sealed_recall.h"

namespace protomark {
namespace {

using Sinks = std::span<const ContainerWriter::Sink>;
using Landmarks = std::span<const LandmarkIndex>;

Histogram histogram_of(const SealedRows& rows) {
  Histogram result{};
  std::vector<std::int8_t> code(rows.dim());
  rows.each_row([&](Row row) {
    rows.code(row, code.data());
    for (const std::int8_t value : code) ++result[static_cast<std::size_t>(value + 128)];
  });
  return result;
}

// The sections that have something per landmark or row. They come into being in one pass over
// landmarks by id and, with an index, another one over its lists.
class SealedContent {
 public:
  SealedContent(const SealedRows& rows, const BlockPacker& packer,
                const std::optional<PositionCodec>& codec)
      : rows_(rows),
        store_(rows.store()),
        packer_(packer),
        codec_(codec),
        owners_(store_.landmark_count()) {
    const auto& ids = store_.ids();
    const std::int64_t largest = ids.empty() ? -1 : *std::ranges::max_element(ids);
    ids_are_stored_ = !ids_are_indices(store_.landmark_count(), largest);
    if (!indexed()) return;
    tests_.emplace(rows);
    if (ids_are_stored_) landmarks_.emplace(store_);
  }

  // Adds the sections to a file that is written as long as this is there.
  void add_to(ContainerWriter& file) {
    const std::size_t n = store_.landmark_count(), row_end = RowWriter::row_end(rows_);
    const ContainerWriter::Part prototypes{section::kPrototypes,
                                           row_end / kPackedRows * packer_.size()};
    std::vector<ContainerWriter::Part> parts{{section::kCounts, n}};
    if (rows_.several()) parts.push_back({section::kRows, n});
    if (codec_) parts.push_back({section::kPositions, n * codec_->size()});
    if (!indexed()) parts.push_back(prototypes);
    if (ids_are_stored_) {
      parts.push_back({section::kIdBlocks, IdBlockWriter::blocks_size(n)});
      parts.push_back({section::kIdGaps, ContainerWriter::kUnknownSize});
    }
    file.add_together(std::move(parts), [this](Sinks sinks) { put_landmarks(sinks); });
    if (!indexed()) return;
    const std::size_t words = owners_.words(row_end);
    file.add_together({prototypes, {section::kOwners, words * sizeof(std::uint64_t)}},
                      [this](Sinks sinks) { put_lists(sinks); });
    file.add(section::kOwnerChecksums, CheckedNumbers::blocks(words) * sizeof(std::uint32_t),
             [this](const auto& sink) { sink(std::as_bytes(std::span(owners_.checksums()))); });
    const std::size_t nlist = store_.centroids().size();
    file.add(section::kCentroids, std::as_bytes(std::span(store_.centroids().centroids())));
    file.add(section::kListRows, nlist * sizeof(std::uint32_t), [this, nlist](const auto& sink) {
      put_values<std::uint32_t>(sink, nlist, 1, [&](std::size_t list, std::uint32_t* to) {
        *to = static_cast<std::uint32_t>(rows_.rows_in(static_cast<std::uint32_t>(list)));
      });
    });
    file.add(section::kRecall, ContainerWriter::kUnknownSize, [this](const auto& sink) {
      const ProbeRanks table = measure_sealed(rows_, packer_, *tests_);
      sink(std::as_bytes(std::span(table)));
    });
  }

 private:
  bool indexed() const { return store_.centroids().size() != 0; }

  LandmarkIndex sealed(LandmarkIndex landmark) const {
    return landmarks_ ? (*landmarks_)[landmark]
                      : LandmarkIndex{static_cast<std::uint32_t>(store_.id(landmark))};
  }

  void put_landmarks(Sinks sinks) {
    auto sink = sinks.begin();
    const auto& counts = *sink++;
    const auto* row_counts = rows_.several() ? &*sink++ : nullptr;
    const auto* positions = codec_ ? &*sink++ : nullptr;
    std::optional<RowWriter> prototypes;
    if (!indexed()) prototypes.emplace(packer_, *sink++);
    std::optional<IdBlockWriter> ids;
    if (ids_are_stored_) ids.emplace(sink[0], sink[1]);
    store_.visit_sorted_landmarks([&](Landmarks landmarks) {
      put_each<std::uint8_t>(counts, landmarks, [&](LandmarkIndex l) {
        return static_cast<std::uint8_t>(std::min(store_.observations(l), 255u));
      });
      if (row_counts != nullptr) {
        put_each<std::uint8_t>(*row_counts, landmarks, [&](LandmarkIndex l) {
          return static_cast<std::uint8_t>(rows_.row_count(l));
        });
      }
      if (positions != nullptr) {
        put_values<std::byte>(*positions, landmarks.size(), codec_->size(), [&](auto i, auto* to) {
          codec_->encode(store_.position(landmarks[i]), to);
        });
      }
      for (const LandmarkIndex landmark : landmarks) {
        if (ids) ids->add(store_.id(landmark));
        if (landmarks_) landmarks_->add(landmark);
        if (tests_) tests_->add(landmark);
        if (!prototypes) continue;
        rows_.each_sorted_row(landmark, [&](Row row) { prototypes->add(row); });
      }
    });
    if (ids) ids->finish();
    if (!prototypes) return;
    prototypes->end_list();
    prototypes->finish();
  }

  void put_lists(Sinks sinks) {
    RowWriter prototypes(packer_, sinks[0]);
    for (std::uint32_t list = 0; list < store_.centroids().size(); ++list) {
      rows_.visit_sorted_rows(list, [&](std::span<const Row> rows) {
        for (const Row row : rows) {
          prototypes.add(row);
          owners_.add(sealed(rows_.owner(row)), sinks[1]);
        }
      });
      prototypes.end_list();
      owners_.end_list(sinks[1]);
    }
    prototypes.finish();
    owners_.finish(sinks[1]);
    landmarks_.reset();  // its memory is wanted for the test queries
  }

  const SealedRows& rows_;
  const PrototypeStore& store_;
  const BlockPacker& packer_;
  const std::optional<PositionCodec>& codec_;
  OwnerWriter owners_;
  bool ids_are_stored_;
  std::optional<TestQueries> tests_;          // with an index
  std::optional<SealedLandmarks> landmarks_;  // with an index, if ids are stored
};

}  // namespace

void PrototypeMap::seal(const std::filesystem::path& path, const SealOptions& options) const {
  if (options.position_bits != 32 && options.position_bits != 16) {
    throw std::invalid_argument("position_bits must be 32 or 16, not " +
                                std::to_string(options.position_bits));
  }
  const std::shared_lock lock(state_->changing);
  const PrototypeStore& store = state_->store;
  const SealFormat format = seal_format(store, options.bytes_per_landmark);
  const SealedRows rows(store, format.row_limit);
  PositionBox box;
  for (const Position& position : store.positions()) box.add(position);
  std::optional<PositionCodec> codec;
  if (box.positions != 0) codec.emplace(box, options.position_bits);
  const int scale = format.bits == 4 ? sq4_best_scale(histogram_of(rows)) : 0;
  const BlockPacker packer(rows, scale);

  ContainerWriter file(FileKind::sealed_map);
  file.add(section::kEncoder, encoder()->serialize());
  add_value(file, section::kShape,
            MapShape{store.landmark_count(), dim(), codec ? codec->origin() : Position{}});
  add_metadata(file, state_->metadata);
  if (scale != 0) add_value(file, section::kScale, static_cast<std::uint32_t>(scale));
  if (codec && codec->bits() == 16) add_value(file, section::kSteps, codec->step());
  SealedContent content(rows, packer, codec);
  content.add_to(file);
  write_guarded(file, path);
}

}  // namespace protomark
