#include "search/among.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace protomark {
namespace {

// Landmarks that are packed at a time: so many that the work on each query is small beside that on
// rows, so few that they stay in the cache.
constexpr std::size_t kPiece = 1 << 14;
// The time to read a row, and to pack one from anywhere, in comparisons of a row and a query.
constexpr double kReading = 40, kPacking = 900;

// Rows that were packed anew.
class PackedPiece {
 public:
  void pack(const Selection& selection, std::span<const LandmarkIndex> landmarks,
            const PackedPrototypes& from) {
    rows_.clear();
    owners_.clear();
    ids_.clear();
    for (const LandmarkIndex landmark : landmarks) {
      selection.append_rows(landmark, rows_);
      owners_.resize(rows_.size(), landmark_at(ids_.size()));
      const std::int64_t* ids = from.landmarks.ids;
      ids_.push_back(ids != nullptr ? ids[landmark.value] : std::int64_t{landmark.value});
    }
    const std::size_t block =
        from.scale == 0 ? packed_size(kPackedRows, from.dim) : packed4_size(kPackedRows, from.dim);
    const std::size_t blocks = (rows_.size() + kPackedRows - 1) / kPackedRows;
    packed_.resize(blocks * block / sizeof(CodeVector));
    const auto* source = static_cast<const std::byte*>(from.data);
    auto* to = reinterpret_cast<std::byte*>(packed_.data());
    const auto start = [&](std::size_t row) {
      return row / kPackedRows * block + row % kPackedRows * kWord;
    };
    for (std::size_t i = 0; i < rows_.size(); ++i) {
      if (i + kAhead < rows_.size()) {
        const std::byte* next = source + start(rows_[i + kAhead].value);
        for (std::size_t at = 0; at < block; at += sizeof(CodeVector)) {
          __builtin_prefetch(next + at);
        }
      }
      const std::byte* row = source + start(rows_[i].value);
      std::byte* packed = to + start(i);
      for (std::size_t at = 0; at < block; at += sizeof(CodeVector)) {
        std::memcpy(packed + at, row + at, kWord);
      }
    }
    view_ = {packed_.data(), rows_.size(), from.dim, from.scale, {}};
    view_.landmarks.of_row = owners_.data();
    view_.landmarks.ids = ids_.data();
  }

  const PackedPrototypes& view() const { return view_; }

 private:
  static constexpr std::size_t kWord = 4, kAhead = 8;

  std::vector<Row> rows_;
  std::vector<LandmarkIndex> owners_;
  std::vector<std::int64_t> ids_;
  std::vector<CodeVector> packed_;
  PackedPrototypes view_;
};

}  // namespace

void sort_unique(std::vector<LandmarkIndex>& landmarks) {
  if (!std::ranges::is_sorted(landmarks)) std::ranges::sort(landmarks);
  landmarks.erase(std::unique(landmarks.begin(), landmarks.end()), landmarks.end());
}

Matches search_among(const Selection& selection, PackedPrototypes prototypes,
                     const InvertedLists& lists, const PackedPrototypes& centroids,
                     std::size_t nprobe, Codes queries, std::size_t k,
                     const SearchOptions& options) {
  const double share = static_cast<double>(selection.landmarks.size()) /
                       static_cast<double>(std::max<std::size_t>(selection.landmark_end, 1));
  if (options.recall && share > 0) {
    const double wanted = std::ceil(static_cast<double>(nprobe) / share);
    nprobe =
        wanted < static_cast<double>(lists.nlist()) ? static_cast<std::size_t>(wanted) : SIZE_MAX;
  }
  const double compared = nprobe < lists.nlist()
                              ? static_cast<double>(nprobe) / static_cast<double>(lists.nlist())
                              : 1.0;
  const auto each = static_cast<double>(queries.rows);
  if (options.nprobe || compared * (kReading + each) < share * (kPacking + each)) {
    std::vector<bool> among(selection.landmark_end);
    for (const LandmarkIndex landmark : selection.landmarks) among[landmark.value] = true;
    prototypes.landmarks.among = &among;
    return search_lists(prototypes, lists, centroids, nprobe, queries, k, options);
  }
  Matches matches = check_search(prototypes.dim, queries, k, options);
  const PreparedCodes prepared(queries);
  Neighbours nearest = prepared.neighbours(k, options);
  PackedPiece piece;
  for (std::size_t first = 0; first < selection.landmarks.size(); first += kPiece) {
    piece.pack(selection,
               std::span(selection.landmarks)
                   .subspan(first, std::min(kPiece, selection.landmarks.size() - first)),
               prototypes);
    scan_all(piece.view(), prepared, options.threads, nearest);
  }
  write_answer(nearest, prepared.norms(), options, 0, matches);
  return matches;
}

}  // namespace protomark
