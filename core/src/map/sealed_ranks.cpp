#include "map/sealed_ranks.h"

#include <algorithm>
#include <array>

#include "base/large_vector.h"
#include "map/prototype_store.h"
#include "search/scan.h"

namespace protomark {
namespace {

// Offers the two nearest landmarks of each query, found in so many rows at a time, to `nearest`.
void search_in_pieces(const SealedRows& rows, const BlockPacker& packer, Codes queries,
                      Neighbours& nearest) {
  // As much memory as is little beside the map.
  const std::size_t some =
      std::max<std::size_t>(1 << 12, rows.size() / 32 / kPackedRows * kPackedRows);
  const PrototypeStore& store = rows.store();
  LargeVector<std::uint8_t> packed(some / kPackedRows * packer.size());
  std::vector<std::uint32_t> piece;
  std::vector<std::int64_t> ids(2 * queries.rows), landmarks;
  std::vector<std::int32_t> distances(ids.size());
  std::vector<LandmarkIndex> itself(some);  // several rows may have the same id
  for (std::uint32_t i = 0; i < some; ++i) itself[i] = {i};
  piece.reserve(some);
  landmarks.reserve(some);
  const auto search_piece = [&] {
    const std::size_t n = piece.size();
    if (n == 0) return;
    piece.resize((n + kPackedRows - 1) / kPackedRows * kPackedRows, kPadding);
    for (std::size_t begin = 0; begin < n; begin += kPackedRows) {
      packer.pack(&piece[begin], &packed[begin / kPackedRows * packer.size()]);
    }
    PackedPrototypes prototypes{packed.data(), n, rows.dim(), packer.half_step()};
    prototypes.landmarks.of_row = itself.data();
    prototypes.landmarks.ids = landmarks.data();
    SearchOptions options;
    options.max_distance = 0;
    for (std::size_t q = 0; q < queries.rows; ++q) {
      options.max_distance = std::max(*options.max_distance, nearest.limit(q));
    }
    search_exact(prototypes, queries, options, {ids.data(), queries.rows, 2},
                 {distances.data(), queries.rows, 2});
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (ids[i] >= 0) nearest[i / 2].offer_distinct(distances[i], ids[i]);
    }
    piece.clear();
    landmarks.clear();
  };
  rows.each_row([&](std::uint32_t row) {
    piece.push_back(row);
    landmarks.push_back(store.ids()[rows.landmark_of(row)]);
    if (piece.size() == some) search_piece();
  });
  search_piece();
}

}  // namespace

RecallTable sealed_ranks(const SealedRows& rows, const BlockPacker& packer,
                         const TestQueries& tests) {
  const std::size_t dim = rows.dim();
  const auto search_two = [&](Codes queries, MatrixView<std::int64_t> ids,
                              MatrixView<std::int32_t> distances) {
    Neighbours nearest(2, std::vector<std::int32_t>(queries.rows, INT32_MAX));
    search_in_pieces(rows, packer, queries, nearest);
    write_answer(nearest, {}, {}, {}, ids, distances);
  };
  const auto cell_of = [&](std::int64_t id, const std::int8_t* query) {
    std::array<std::int8_t, 256> code;
    std::int32_t least = INT32_MAX;
    std::uint32_t nearest = 0;
    rows.each_sorted_row(rows.store().at(id), [&](std::uint32_t row) {
      rows.code(row, code.data());
      std::int32_t distance = 0;
      for (std::size_t d = 0; d < dim; ++d) {
        const int difference = query[d] - packer.value(code[d]);
        distance += difference * difference;
      }
      if (distance >= least) return;
      least = distance;
      nearest = row;
    });
    return rows.cell_of(nearest);
  };
  return measure_recall(tests.codes(), tests.own(), rows.store().cells(), search_two, cell_of);
}

}  // namespace protomark
