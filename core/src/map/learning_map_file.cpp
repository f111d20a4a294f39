#include "map/learning_map_file.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <string>
#include <utility>

#include "base/id_index.h"
#include "file/sections.h"
#include "map/map_sections.h"
#include "protomark/prototype_map.h"

namespace protomark {

LandmarkSections::LandmarkSections(const PrototypeStore& store)
    : store_(&store),
      landmark_count_(store.landmark_count()),
      row_count_(store.prototype_count()) {}

LandmarkSections::LandmarkSections(const PrototypeStore& store,
                                   std::vector<LandmarkIndex> landmarks)
    : store_(&store), some_(std::move(landmarks)), landmark_count_(some_->size()) {
  for (const LandmarkIndex landmark : *some_) row_count_ += store.row_count(landmark);
}

void LandmarkSections::add_to(ContainerWriter& file) const {
  const std::size_t n = landmark_count_, m = row_count_;
  add_value(file, section::kShape, MapShape{n, store_->dim(), {}});
  std::vector<ContainerWriter::Part> parts{{section::kIds, n * sizeof(std::int64_t)}};
  if (store_->several()) {
    add_value(file, section::kAppearanceBits,
              static_cast<std::uint32_t>(store_->appearance_bits()));
    parts.push_back({section::kRows, n * sizeof(std::uint32_t)});
    parts.push_back({section::kAppearances, m * sizeof(std::uint16_t)});
  }
  parts.push_back({section::kCounts, m});
  parts.push_back({section::kSums, m * store_->dim() * sizeof(std::int16_t)});
  // A map whose positions were all taken away equals one that never had any.
  const bool positions =
      some_ ? std::ranges::any_of(*some_, has_position,
                                  [&](LandmarkIndex l) { return store_->position(l); })
            : store_->any_position();
  if (positions) parts.push_back({section::kPositions, n * sizeof(Position)});
  file.add_together(std::move(parts), [this, positions](auto sinks) { put(sinks, positions); });
}

void LandmarkSections::put(std::span<const ContainerWriter::Sink> sinks, bool positions) const {
  constexpr std::size_t kRows = 1 << 13;  // at a time, and those of one landmark
  const auto visit = [&](std::span<const LandmarkIndex> landmarks) {
    for (std::size_t first = 0, end = 0; first < landmarks.size(); first = end) {
      for (std::size_t rows = 0; end < landmarks.size() && rows < kRows; ++end) {
        rows += store_->row_count(landmarks[end]);
      }
      put_piece(sinks, landmarks.subspan(first, end - first), positions);
    }
  };
  if (some_) {
    visit(*some_);
  } else {
    store_->visit_sorted_landmarks(visit);
  }
}

void LandmarkSections::put_piece(std::span<const ContainerWriter::Sink> sinks,
                                 std::span<const LandmarkIndex> landmarks, bool positions) const {
  const std::vector<Row> rows = store_->sorted_rows(landmarks);
  const std::span<const Row> all(rows);
  auto sink = sinks.begin();
  put_each<std::int64_t>(*sink++, landmarks, [&](LandmarkIndex l) { return store_->id(l); });
  if (store_->several()) {
    put_each<std::uint32_t>(*sink++, landmarks, [&](LandmarkIndex l) {
      return static_cast<std::uint32_t>(store_->row_count(l));
    });
    put_each<std::uint16_t>(*sink++, all, [&](Row row) { return store_->appearance(row); });
  }
  put_each<std::uint8_t>(*sink++, all,
                         [&](Row row) { return static_cast<std::uint8_t>(store_->count(row)); });
  put_values<std::int16_t>(*sink++, rows.size(), store_->dim(), [&](std::size_t i, auto* to) {
    std::copy_n(store_->sum(rows[i]), store_->dim(), to);
  });
  if (!positions) return;
  put_each<Position>(*sink, landmarks, [&](LandmarkIndex l) { return store_->position(l); });
}

std::size_t read_appearance_bits(const ContainerReader& file, std::size_t dim) {
  if (!file.has(section::kAppearanceBits)) return 0;
  const auto bits = read_value<std::uint32_t>(file, section::kAppearanceBits);
  const std::size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  if (bits == 0 || bits > limit) {
    file.fail("its appearances have " + std::to_string(bits) + " bits, not 1 to " +
              std::to_string(limit));
  }
  return bits;
}

namespace {

// Reads commits and the map file, from the newest to the oldest, so that nothing that was read has
// to be found and taken back: what is older counts only for landmarks that no later commit names.
class Reading {
 public:
  Reading(const Encoder& encoder, PrototypeStore& store) : encoder_(encoder), store_(store) {}

  void read_commit(const ContainerReader& commit) {
    const MapShape shape = read_shape(commit, encoder_);
    if (shape.dim != store_.dim() ||
        read_appearance_bits(commit, shape.dim) != store_.appearance_bits()) {
      commit.fail("its dimension or appearance bits are not the map's");
    }
    read_landmarks(commit, shape.landmarks);
    for (const char* name : {section::kIds, section::kRemoved}) {
      if (!commit.has(name)) continue;
      const auto ids =
          read_section<std::int64_t>(commit, name, commit.map(name).size() / sizeof(std::int64_t));
      check_ids(commit, ids);
      for (const std::int64_t id : ids) known_.insert(id);
    }
    if (commit.has(section::kCentroids)) {
      // Present and empty: there is no index any more.
      auto own = commit.map(section::kCentroids).empty() ? std::vector<std::int8_t>()
                                                         : read_centroids(commit, shape.dim);
      if (!centroids_) centroids_ = std::move(own);
    }
    if (commit.has(section::kMetadata)) {
      auto own = read_metadata(commit);
      if (!metadata_) metadata_ = std::move(own);
    }
  }

  LearningMapContent read_map(const ContainerReader& file) {
    auto metadata = read_metadata(file);
    auto centroids = read_centroids(file, store_.dim());
    read_landmarks(file, read_shape(file, encoder_).landmarks);
    return {metadata_ ? std::move(*metadata_) : std::move(metadata),
            centroids_ ? std::move(*centroids_) : std::move(centroids)};
  }

 private:
  // Checks all landmarks of a file, and takes those that are not known.
  void read_landmarks(const ContainerReader& file, std::size_t n) {
    const std::size_t dim = store_.dim();
    const bool several = store_.several();
    const auto ids = read_section<std::int64_t>(file, section::kIds, n);
    check_ids(file, ids);
    std::vector<std::uint32_t> row_counts;
    std::vector<std::uint16_t> appearances;
    std::size_t m = n;
    if (several) {
      row_counts = read_section<std::uint32_t>(file, section::kRows, n);
      m = sum_rows(file, std::span<const std::uint32_t>(row_counts));
      appearances = read_section<std::uint16_t>(file, section::kAppearances, m);
    }
    const auto counts = read_section<std::uint8_t>(file, section::kCounts, m);
    const auto sums = read_section<std::int16_t>(file, section::kSums, m * dim);
    std::vector<Position> positions;
    if (file.has(section::kPositions)) {
      positions = read_section<Position>(file, section::kPositions, n);
    }

    // Before many small commits, each of which would move all that is there.
    if (m > store_.prototype_count()) {
      store_.reserve(store_.landmark_count() + n, store_.prototype_count() + m);
    }
    std::vector<LandmarkIndex> landmarks;  // if there are positions
    landmarks.reserve(positions.size());
    for (std::size_t i = 0, row = 0; i < n; ++i) {
      const bool wanted = known_.empty() || !known_.contains(ids[i]);
      LandmarkIndex landmark = kNoLandmark;
      const std::size_t end = row + (several ? row_counts[i] : 1);
      for (const std::size_t first = row; row < end; ++row) {
        const std::int16_t* sum = &sums[row * dim];
        check_prototype(file, ids[i], sum, counts[row]);
        const std::uint16_t appearance = several ? appearances[row] : 0;
        if (appearance >> store_.appearance_bits() != 0 ||
            (row > first && appearance <= appearances[row - 1])) {
          file.fail("the appearances of landmark " + std::to_string(ids[i]) + " do not ascend");
        }
        if (!wanted) continue;
        const Row to = row == first ? store_.create_landmark(ids[i], appearance)
                                    : store_.create_row(landmark, appearance);
        landmark = store_.owner(to);
        std::copy_n(sum, dim, store_.sum(to));
        store_.set_count(to, counts[row]);
        store_.refresh(to);
      }
      if (positions.empty()) continue;
      landmarks.push_back(landmark);
      const bool finite =
          std::ranges::all_of(positions[i], [](double x) { return std::isfinite(x); });
      if (!finite && has_position(positions[i])) {
        file.fail("landmark " + std::to_string(ids[i]) + " has no finite position");
      }
    }
    // After the landmarks, so that room for positions is made once.
    for (std::size_t i = 0; i < positions.size(); ++i) {
      if (landmarks[i] != kNoLandmark) store_.set_position(landmarks[i], positions[i]);
    }
  }

  void check_prototype(const ContainerReader& file, std::int64_t id, const std::int16_t* sum,
                       int count) const {
    if (count == 0 ||
        std::any_of(sum, sum + store_.dim(), [&](int s) { return std::abs(s) > 127 * count; })) {
      file.fail("landmark " + std::to_string(id) + " has an impossible prototype");
    }
  }

  const Encoder& encoder_;
  PrototypeStore& store_;
  IdSet known_;  // landmarks that came, changed or went in later commits
  std::optional<Metadata> metadata_;
  std::optional<std::vector<std::int8_t>> centroids_;
};

}  // namespace

LearningMapContent read_learning_map(const ContainerReader& file, const JournalContent& journal,
                                     const Encoder& encoder, PrototypeStore& store) {
  Reading reading(encoder, store);
  const auto commits = journal.commits(file.identity());
  for (auto commit = commits.rbegin(); commit != commits.rend(); ++commit) {
    const std::string name = journal.name() + ": record at byte " + std::to_string(commit->offset);
    reading.read_commit(ContainerReader(commit->bytes, name));
  }
  return reading.read_map(file);
}

}  // namespace protomark
