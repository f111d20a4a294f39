#include "map/landmark_sections.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <string>
#include <utility>

namespace protomark {

LandmarkSections::LandmarkSections(const PrototypeStore& store)
    : store_(&store), size_(store.landmarks()), rows_(store.rows()) {}

LandmarkSections::LandmarkSections(const PrototypeStore& store,
                                   std::vector<std::uint32_t> landmarks)
    : store_(&store), some_(std::move(landmarks)), size_(some_->size()) {
  for (const std::uint32_t landmark : *some_) rows_ += store.rows_of(landmark);
}

void LandmarkSections::visit(const PrototypeStore::Visit& visit) const {
  if (some_) {
    visit(*some_);
  } else {
    store_->visit_sorted_landmarks(visit);
  }
}

void LandmarkSections::add_to(ContainerWriter& file) const {
  const std::size_t n = size_, m = rows_;
  std::vector<ContainerWriter::Part> parts{{section::kIds, n * sizeof(std::int64_t)}};
  if (store_->look_bits() != 0) {
    file.add(section::kLookBits, write_look_bits(store_->look_bits()));
    parts.push_back({section::kRows, n * sizeof(std::uint32_t)});
    parts.push_back({section::kLooks, m * sizeof(std::uint16_t)});
  }
  parts.push_back({section::kCounts, m});
  parts.push_back({section::kSums, m * store_->dim() * sizeof(std::int16_t)});
  // A map whose positions were all taken away equals one that never had any.
  const auto is_placed = [&](std::uint32_t l) { return !is_nowhere(store_->position(l)); };
  const bool placed =
      some_ ? std::any_of(some_->begin(), some_->end(), is_placed)
            : !std::all_of(store_->positions().begin(), store_->positions().end(), is_nowhere);
  if (placed) parts.push_back({section::kPositions, n * sizeof(Position)});
  file.add_together(std::move(parts), [this, placed](auto sinks) { put(sinks, placed); });
}

void LandmarkSections::put(std::span<const ContainerWriter::Sink> sinks, bool placed) const {
  constexpr std::size_t kRows = 1 << 13;  // at a time, and those of one landmark
  const PrototypeStore& store = *store_;
  visit([&](std::span<const std::uint32_t> piece) {
    for (std::size_t first = 0, end = 0; first < piece.size(); first = end) {
      for (std::size_t rows = 0; end < piece.size() && rows < kRows; ++end) {
        rows += store.rows_of(piece[end]);
      }
      const auto some = piece.subspan(first, end - first);
      const std::vector<std::uint32_t> rows = store.sorted_rows(some);
      auto sink = sinks.begin();
      put_values<std::int64_t>(*sink++, some.size(), 1, [&](std::size_t i, std::int64_t* to) {
        *to = store.ids()[some[i]];
      });
      if (store.look_bits() != 0) {
        put_values<std::uint32_t>(*sink++, some.size(), 1, [&](std::size_t i, std::uint32_t* to) {
          *to = static_cast<std::uint32_t>(store.rows_of(some[i]));
        });
        put_values<std::uint16_t>(*sink++, rows.size(), 1, [&](std::size_t i, std::uint16_t* to) {
          *to = store.look(rows[i]);
        });
      }
      put_values<std::uint8_t>(*sink++, rows.size(), 1, [&](std::size_t i, std::uint8_t* to) {
        *to = store.count(rows[i]);
      });
      put_values<std::int16_t>(*sink++, rows.size(), store.dim(),
                               [&](std::size_t i, std::int16_t* to) {
                                 std::copy_n(store.sum(rows[i]), store.dim(), to);
                               });
      if (!placed) continue;
      put_values<Position>(*sink, some.size(), 1,
                           [&](std::size_t i, Position* to) { *to = store.position(some[i]); });
    }
  });
}

void read_landmarks(const ContainerReader& file, const MapShape& shape, const IdSet& known,
                    PrototypeStore& store) {
  const std::size_t n = shape.landmarks, dim = shape.dim, look_bits = store.look_bits();
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

  // Of many small commits each would move all that is there.
  if (m > store.rows()) store.reserve(store.landmarks() + n, store.rows() + m);
  std::vector<std::uint32_t> landmarks;  // where there are positions
  landmarks.reserve(positions.size());
  for (std::size_t i = 0, next = 0; i < n; ++i) {
    const bool wanted = known.empty() || !known.contains(ids[i]);
    const std::uint32_t landmark = wanted ? store.create_landmark(ids[i]) : PrototypeStore::kNone;
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
      if (!wanted) continue;
      const std::uint32_t row = store.create_row(landmark, look_bits != 0 ? looks[next] : 0);
      std::copy_n(sum, dim, store.sum(row));
      store.set_count(row, count);
      store.refresh(row);
    }
    if (positions.empty()) continue;
    landmarks.push_back(landmark);
    const Position& p = positions[i];
    const bool finite = std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
    if (!finite && !is_nowhere(p)) {
      file.fail("landmark " + std::to_string(ids[i]) + " has no finite position");
    }
  }
  // After the landmarks, so that room for positions is made once.
  for (std::size_t i = 0; i < positions.size(); ++i) {
    if (landmarks[i] != PrototypeStore::kNone) store.set_position(landmarks[i], positions[i]);
  }
}

}  // namespace protomark
