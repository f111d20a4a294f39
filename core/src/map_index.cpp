// The index of an open map.
#include <mutex>
#include <shared_mutex>
#include <stdexcept>
#include <string>

#include "cell_search.h"
#include "prototype_store.h"

namespace protomark {
namespace {

constexpr char kRemedy[] = "call build_index first";
// Share of the rows that may change before probes are measured again.
constexpr std::size_t kStaleShare = 10;

}  // namespace

void PrototypeMap::build_index(std::optional<std::size_t> cells, int threads) {
  if (threads < 1) throw std::invalid_argument("threads must be at least 1");
  const std::unique_lock lock(store_->mutex);
  const std::size_t rows = store_->rows();
  if (rows == 0) throw std::invalid_argument("a map without landmarks has no cells to learn");
  const std::size_t number = cells.value_or(Cells::number_for(rows, dim_));
  const std::size_t most = std::min(rows, Cells::kMaxCells);
  if (number < 1 || number > most) {
    throw std::invalid_argument("this map can have 1 to " + std::to_string(most) + " cells, not " +
                                std::to_string(number));
  }
  // By id, so that cells do not depend on how the map came about.
  const std::vector<std::uint32_t> sorted = store_->sorted_rows();
  std::vector<std::uint32_t> sample(std::min(rows, Cells::sample_for(number)));
  for (std::size_t i = 0; i < sample.size(); ++i) sample[i] = sorted[i * rows / sample.size()];
  const std::vector<std::int8_t> codes = store_->rounded(sample);
  store_->set_cells(Cells::learn({codes.data(), sample.size(), dim_}, number, threads), threads);
}

void PrototypeMap::drop_index() {
  const std::unique_lock lock(store_->mutex);
  store_->set_cells({}, 1);
}

std::size_t PrototypeMap::index_cells() const {
  const std::shared_lock lock(store_->mutex);
  return store_->cells().size();
}

std::size_t PrototypeMap::probes(double recall, int threads) const {
  const std::shared_lock lock(store_->mutex);
  const std::size_t cells = store_->cells().size();
  check_recall(recall, cells, kRemedy);
  return probes_for(store_->ranks(threads), recall, cells);
}

void PrototypeMap::search_codes(Codes queries, const SearchOptions& options,
                                MatrixView<std::int64_t> ids, MatrixView<float> distances) const {
  const std::shared_lock lock(store_->mutex);
  const std::size_t cells = store_->cells().size();
  const auto probes = asked_probes(options, cells, kRemedy);
  if (!probes) {
    protomark::search(store_->view(), queries, options, ids, distances);
    return;
  }
  const std::size_t searched =
      options.recall ? probes_for(store_->ranks(options.threads), *options.recall, cells) : *probes;
  if (searched >= cells) {
    protomark::search(store_->view(), queries, exact(options), ids, distances);
    return;
  }
  search_cells(store_->view(), CellView(store_->blocks()), store_->cells().packed(), searched,
               queries, exact(options), ids, distances);
}

ProbeRanks PrototypeMap::Store::ranks(int threads) const {
  const std::scoped_lock lock(ranks_mutex_);
  if (!ranks_.empty() && (changes() - ranks_changes_) * kStaleShare < rows()) return ranks_;
  const std::vector<std::uint32_t> sorted = sorted_rows();
  std::vector<std::uint32_t> rows;
  std::vector<std::int64_t> own;
  for (const std::size_t i : test_rows(sorted.size())) {
    rows.push_back(sorted[i]);
    own.push_back(ids()[landmark_of(sorted[i])]);
  }
  const std::vector<std::int8_t> codes = rounded(rows);
  const auto search_two = [&](Codes queries, MatrixView<std::int64_t> ids,
                              MatrixView<float> distances) {
    SearchOptions options;
    options.threads = threads;
    protomark::search(view(), queries, options, ids, distances);
  };
  const auto cell_of = [&](std::int64_t id, const std::int8_t* query) {
    std::uint32_t cell = 0;
    std::int32_t least = INT32_MAX;
    for (std::uint32_t row = first_row(at(id)); row != kNone; row = next_row(row)) {
      std::int32_t distance = 0;
      for (std::size_t d = 0; d < dim(); ++d) {
        const int difference = query[d] - rounded(row, d);
        distance += difference * difference;
      }
      if (distance >= least) continue;
      least = distance;
      cell = blocks().cell_of(row);
    }
    return cell;
  };
  ranks_ = measure_ranks({codes.data(), rows.size(), dim()}, own, cells().centroids(), search_two,
                         cell_of);
  ranks_changes_ = changes();
  return ranks_;
}

}  // namespace protomark
