#include "map/sealed_ranks.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "base/large_vector.h"
#include "map/prototype_store.h"
#include "search/top_k.h"

namespace protomark {
namespace {

// Offers the two nearest landmarks of each query, found in so many rows at a time, to `offer(query,
// id of the landmark, distance)`; none further away than farthest() says before each time.
template <typename Offer, typename Farthest>
void search_in_pieces(const SealedRows& rows, const BlockPacker& packer, Codes queries,
                      const Offer& offer, const Farthest& farthest) {
  // As much memory as is little beside the map.
  const std::size_t some =
      std::max<std::size_t>(1 << 12, rows.size() / 32 / kPackedRows * kPackedRows);
  const PrototypeStore& store = rows.store();
  LargeVector<std::uint8_t> packed(some / kPackedRows * packer.size());
  std::vector<std::uint32_t> piece;
  std::vector<std::int64_t> ids(2 * queries.rows), landmarks;
  std::vector<float> distances(ids.size());
  std::vector<std::uint32_t> itself(some);  // several rows may have the same id
  std::iota(itself.begin(), itself.end(), 0u);
  piece.reserve(some);
  landmarks.reserve(some);
  const auto search_piece = [&] {
    const std::size_t n = piece.size();
    if (n == 0) return;
    piece.resize((n + kPackedRows - 1) / kPackedRows * kPackedRows, kPadding);
    for (std::size_t begin = 0; begin < n; begin += kPackedRows) {
      packer.pack(&piece[begin], &packed[begin / kPackedRows * packer.size()]);
    }
    RowLandmarks numbers;
    numbers.of_row = itself.data();
    const MatrixView<std::int64_t> nearest{ids.data(), queries.rows, 2};
    const MatrixView<float> far{distances.data(), queries.rows, 2};
    SearchOptions options;
    options.max_distance = farthest();
    const auto find = [&](const auto& prototypes) {
      search(prototypes, queries, options, nearest, far);
    };
    if (packer.half_step() == 0) {
      const auto* codes = reinterpret_cast<const std::int8_t*>(packed.data());
      find(PackedPrototypes{codes, n, rows.dim(), landmarks.data(), numbers});
    } else {
      find(PackedPrototypes4{packed.data(), n, rows.dim(), packer.half_step(), landmarks.data(),
                             numbers});
    }
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (ids[i] >= 0) offer(i / 2, ids[i], distances[i]);
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

ProbeRanks sealed_ranks(const SealedRows& rows, const BlockPacker& packer,
                        const TestQueries& tests) {
  const std::size_t dim = rows.dim();
  struct Nearest {
    std::int32_t distance = INT32_MAX;
    std::uint32_t row = 0;
  };
  const auto nearest_row = [&](std::int64_t id, const std::int8_t* query) {
    std::array<std::int8_t, 256> code;
    Nearest result;
    rows.each_sorted_row(rows.store().at(id), [&](std::uint32_t row) {
      rows.code(row, code.data());
      std::int32_t distance = 0;
      for (std::size_t d = 0; d < dim; ++d) {
        const int difference = query[d] - packer.value(code[d]);
        distance += difference * difference;
      }
      if (distance < result.distance) result = {distance, row};
    });
    return result;
  };
  const auto search_two = [&](Codes queries, MatrixView<std::int64_t> ids, MatrixView<float>) {
    std::vector<std::int32_t> distances(2 * queries.rows);
    std::vector<TopK> best;
    for (std::size_t q = 0; q < queries.rows; ++q) {
      best.emplace_back(ids.row(q), &distances[2 * q], 2, INT32_MAX - 1);
    }
    // Floats do not tell all distances apart, but those that are far too large.
    const auto offer = [&](std::size_t q, std::int64_t id, double distance) {
      if (distance * distance > 1.00001 * best[q].limit()) return;
      best[q].offer_distinct(nearest_row(id, queries.row(q)).distance, id);
    };
    const auto farthest = [&]() -> std::optional<float> {
      std::int32_t most = 0;
      for (const TopK& one : best) most = std::max(most, one.limit());
      if (most >= INT32_MAX - 1) return std::nullopt;
      return std::sqrt(static_cast<float>(most)) * 1.00001f;
    };
    search_in_pieces(rows, packer, queries, offer, farthest);
  };
  const auto cell_of = [&](std::int64_t id, const std::int8_t* query) {
    return rows.cell_of(nearest_row(id, query).row);
  };
  return measure_ranks(tests.codes(), tests.own(), rows.store().cells().centroids(), search_two,
                       cell_of);
}

}  // namespace protomark
