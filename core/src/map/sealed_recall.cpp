#include "map/sealed_recall.h"

#include <array>
#include <cmath>
#include <optional>

#include "base/large_vector.h"
#include "search/top_k.h"

namespace protomark {
namespace {

// Calls offer(query, id, distance) for the two nearest landmarks of each query within each piece of
// the rows, none further away than limit() says before the piece.
template <typename Offer, typename Limit>
void search_pieces(const SealedRows& rows, const BlockPacker& packer, Codes queries,
                   const Offer& offer, const Limit& limit) {
  // As much memory as is little beside the map.
  const std::size_t size =
      std::max<std::size_t>(1 << 12, rows.size() / 32 / kPackedRows * kPackedRows);
  LargeVector<std::uint8_t> packed(size / kPackedRows * packer.size());
  std::vector<Row> piece;
  std::vector<std::int64_t> owners;
  std::vector<std::uint32_t> own_index(size);  // several rows may have the same id
  std::iota(own_index.begin(), own_index.end(), 0u);
  Matrix<std::int64_t> ids(queries.rows, 2);
  Matrix<float> distances(queries.rows, 2);
  piece.reserve(size);
  owners.reserve(size);
  const auto search_piece = [&] {
    const std::size_t n = piece.size();
    if (n == 0) return;
    piece.resize((n + kPackedRows - 1) / kPackedRows * kPackedRows, kNoRow);
    for (std::size_t begin = 0; begin < n; begin += kPackedRows) {
      packer.pack(&piece[begin], &packed[begin / kPackedRows * packer.size()]);
    }
    RowLandmarks landmarks;
    landmarks.of_row = own_index.data();
    SearchOptions options;
    options.max_distance = limit();
    const auto find = [&](const auto& prototypes) {
      search(prototypes, queries, options, ids.view(), distances.view());
    };
    if (packer.scale() == 0) {
      const auto* codes = reinterpret_cast<const std::int8_t*>(packed.data());
      find(PackedPrototypes{codes, n, rows.dim(), owners.data(), landmarks});
    } else {
      find(PackedPrototypes4{packed.data(), n, rows.dim(), packer.scale(), owners.data(),
                             landmarks});
    }
    for (std::size_t i = 0; i < ids.data.size(); ++i) {
      if (ids.data[i] >= 0) offer(i / 2, ids.data[i], distances.data[i]);
    }
    piece.clear();
    owners.clear();
  };
  rows.each_row([&](Row row) {
    piece.push_back(row);
    owners.push_back(rows.store().id(rows.owner(row)));
    if (piece.size() == size) search_piece();
  });
  search_piece();
}

}  // namespace

ProbeRanks measure_sealed(const SealedRows& rows, const BlockPacker& packer,
                          const TestQueries& tests) {
  const std::size_t dim = rows.dim();
  struct Nearest {
    std::int32_t distance = INT32_MAX;
    Row row;
  };
  const auto nearest_row = [&](std::int64_t id, const std::int8_t* query) {
    std::array<std::int8_t, 256> code;
    Nearest result;
    rows.each_sorted_row(rows.store().at(id), [&](Row row) {
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
    const auto limit = [&]() -> std::optional<float> {
      std::int32_t largest = 0;
      for (const TopK& one : best) largest = std::max(largest, one.limit());
      if (largest >= INT32_MAX - 1) return std::nullopt;
      return std::sqrt(static_cast<float>(largest)) * 1.00001f;
    };
    search_pieces(rows, packer, queries, offer, limit);
  };
  const auto list_of = [&](std::int64_t id, const std::int8_t* query) {
    return rows.list_of(nearest_row(id, query).row);
  };
  return measure_ranks(tests.codes(), tests.own(), rows.store().centroids().centroids(), search_two,
                       list_of);
}

}  // namespace protomark
