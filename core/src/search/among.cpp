#include "search/among.h"

#include <cmath>

namespace protomark {
namespace {

// Landmarks that are packed at a time: so many that the work on each query is small beside that on
// rows, so few that they stay in the cache.
constexpr size_t kPiece = 1 << 14;
// The time to read a row, and to pack one from anywhere, in comparisons of a row and a query.
constexpr double kReading = 40, kPacking = 900;

// Rows that were packed anew.
class PackedPiece {
 public:
  void pack(const LandmarkRows& landmarks, std::span<const LandmarkIndex> some,
            const PackedPrototypes& from) {
    rows_.clear();
    owners_.clear();
    ids_.clear();
    for (const LandmarkIndex landmark : some) {
      landmarks.append(landmark, rows_);
      owners_.resize(rows_.size(), landmark_at(ids_.size()));
      const int64_t* ids = from.landmarks.ids;
      ids_.push_back(ids != nullptr ? ids[landmark.value] : int64_t{landmark.value});
    }
    // What a row has in one place: 4 numbers or a word.
    from.width == 0 ? copy_rows<4>(from) : copy_rows<1>(from);
    view_ = {packed_.data(), rows_.size(), from.dim, from.width, from.table, {}};
    view_.landmarks.of_row = owners_.data();
    view_.landmarks.ids = ids_.data();
  }

  const PackedPrototypes& view() const { return view_; }

 private:
  template <size_t kBytes>
  void copy_rows(const PackedPrototypes& from) {
    constexpr size_t kAhead = 8;
    const size_t block = packed_size(kPackedRows, from.dim, from.width);
    packed_.resize(packed_blocks(rows_.size()) * block / sizeof(CodeVector) + 1);
    const auto* source = static_cast<const std::byte*>(from.data);
    auto* to = reinterpret_cast<std::byte*>(packed_.data());
    const auto start = [&](size_t row) {
      return row / kPackedRows * block + row % kPackedRows * kBytes;
    };
    for (size_t i = 0; i < rows_.size(); ++i) {
      if (i + kAhead < rows_.size()) {
        const std::byte* next = source + start(rows_[i + kAhead].value);
        for (size_t at = 0; at < block; at += sizeof(CodeVector)) {
          __builtin_prefetch(next + at);
        }
      }
      const std::byte* row = source + start(rows_[i].value);
      std::byte* packed = to + start(i);
      for (size_t at = 0; at < block; at += kPackedRows * kBytes) {
        std::memcpy(packed + at, row + at, kBytes);
      }
    }
  }

  std::vector<Row> rows_;
  std::vector<LandmarkIndex> owners_;
  std::vector<int64_t> ids_;
  std::vector<CodeVector> packed_;
  PackedPrototypes view_;
};

}  // namespace

Matches search_map(PackedPrototypes prototypes, const InvertedLists& lists,
                   const PackedPrototypes& centroids, const LandmarkRows& landmarks, size_t nprobe,
                   Codes queries, size_t k, const SearchOptions& options) {
  if (!options.among) {
    return search_lists(prototypes, lists, centroids, nprobe, queries, k, options);
  }
  std::vector<LandmarkIndex> some;
  for (const int64_t id : *options.among) some.push_back(landmarks.at(id));
  sort_unique(some);
  const double share =
      static_cast<double>(some.size()) / static_cast<double>(std::max<size_t>(landmarks.end, 1));
  if (options.recall && share > 0) {
    const double wanted = std::ceil(static_cast<double>(nprobe) / share);
    nprobe = wanted < static_cast<double>(lists.nlist()) ? static_cast<size_t>(wanted) : SIZE_MAX;
  }
  const double compared = nprobe < lists.nlist()
                              ? static_cast<double>(nprobe) / static_cast<double>(lists.nlist())
                              : 1.0;
  const auto each = static_cast<double>(queries.rows);
  if (options.nprobe || compared * (kReading + each) < share * (kPacking + each)) {
    std::vector<bool> among(landmarks.end);
    for (const LandmarkIndex landmark : some) among[landmark.value] = true;
    prototypes.landmarks.among = &among;
    return search_lists(prototypes, lists, centroids, nprobe, queries, k, options);
  }
  Matches matches = check_search(prototypes.dim, queries, k, options);
  const PreparedCodes prepared(queries);
  Neighbours nearest = prepared.neighbours(k, options);
  PackedPiece piece;
  for (size_t first = 0; first < some.size(); first += kPiece) {
    piece.pack(landmarks, std::span(some).subspan(first, std::min(kPiece, some.size() - first)),
               prototypes);
    scan_all(piece.view(), prepared, options.threads, nearest);
  }
  write_answer(nearest, prepared.norms(), options, 0, matches);
  return matches;
}

}  // namespace protomark
