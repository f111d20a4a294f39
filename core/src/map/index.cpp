// The index of an open map.
#include <memory>
#include <mutex>
#include <shared_mutex>
#include <stdexcept>
#include <string>
#include <utility>

#include "map/prototype_store.h"
#include "search/inverted_lists.h"
#include "search/scan.h"

namespace protomark {
namespace {

constexpr char kRemedy[] = "call build_index first";
// Share of the rows that may change before probes are measured again.
constexpr std::size_t kStaleShare = 10;

}  // namespace

void PrototypeMap::build_index(std::optional<std::size_t> cells, int threads, bool in_place) {
  if (threads < 1) throw std::invalid_argument("threads must be at least 1");
  const std::unique_lock changing(store_->changing);
  const std::size_t rows = store_->rows();
  if (rows == 0) throw std::invalid_argument("a map without landmarks has no cells to learn");
  const std::size_t number =
      cells.value_or(CoarseQuantizer::default_nlist(rows, dim_, store_->place_bytes()));
  const std::size_t most = std::min(rows, CoarseQuantizer::kMaxLists);
  if (number < 1 || number > most) {
    throw std::invalid_argument("this map can have 1 to " + std::to_string(most) + " cells, not " +
                                std::to_string(number));
  }
  store_->put_into_cells(store_->learn_cells(number, threads), threads, in_place);
}

void PrototypeMap::drop_index() {
  const std::unique_lock changing(store_->changing);
  store_->put_into_cells({}, 1, false);
}

// By id, so that cells do not depend on how the map came about.
CoarseQuantizer PrototypeMap::Store::learn_cells(std::size_t number, int threads) const {
  std::vector<std::size_t> sample(std::min(rows(), CoarseQuantizer::sample_size(number)));
  for (std::size_t i = 0; i < sample.size(); ++i) sample[i] = i * rows() / sample.size();
  const std::vector<std::int8_t> codes = rounded(rows_at(sample));
  return CoarseQuantizer::learn({codes.data(), sample.size(), dim()}, number, threads);
}

std::size_t PrototypeMap::index_cells() const {
  const std::shared_lock lock(store_->mutex);
  return store_->cells().nlist();
}

std::size_t PrototypeMap::probes(double recall, int threads) const {
  std::shared_lock lock(store_->mutex);
  const auto measured = store_->ranks(lock, recall, threads);
  return nprobe_for(measured->table, recall, store_->cells().nlist());
}

void PrototypeMap::search_codes(Codes queries, const SearchOptions& options,
                                MatrixView<std::int64_t> ids,
                                MatrixView<std::int32_t> distances) const {
  std::shared_lock lock(store_->mutex);
  auto nprobe = requested_nprobe(options, store_->cells().nlist(), kRemedy);
  if (options.recall) {
    const auto measured = store_->ranks(lock, *options.recall, options.threads);
    nprobe = nprobe_for(measured->table, *options.recall, store_->cells().nlist());
  }
  if (!nprobe) return search_exact(store_->view(), queries, options, ids, distances);
  search_lists(store_->view(), InvertedLists(store_->blocks()), store_->cells().packed(), *nprobe,
               queries, options, ids, distances);
}

std::shared_ptr<const MeasuredRecall> PrototypeMap::Store::ranks(
    std::shared_lock<FairSharedMutex>& lock, double recall, int threads) const {
  for (bool tried = false;; tried = true) {
    check_recall(recall, cells().nlist(), kRemedy);
    std::shared_ptr<const MeasuredRecall> known;
    {
      const std::scoped_lock reading(ranks_mutex_);
      known = ranks_;
    }
    const bool of_these = known && known->lists_version == cells_version();
    if (of_these && (tried || !is_stale(*known))) return known;
    lock.unlock();
    measure(threads, !of_these);
    lock.lock();
  }
}

bool PrototypeMap::Store::is_stale(const MeasuredRecall& ranks) const {
  return ranks.lists_version != cells_version() ||
         (changes() - ranks.changes) * kStaleShare >= rows();
}

// Without `wait` only where nobody else measures or changes the map.
void PrototypeMap::Store::measure(int threads, bool wait) const {
  std::unique_lock one(measuring_, std::defer_lock);
  std::shared_lock still(changing, std::defer_lock);
  if (wait) {
    one.lock();
    still.lock();
  } else if (!one.try_lock() || !still.try_lock()) {
    return;
  }
  if (cells().nlist() == 0 || (ranks_ && !is_stale(*ranks_))) return;
  const std::vector<std::uint32_t> rows = rows_at(test_rows(this->rows()));
  std::vector<std::int64_t> own;
  for (const std::uint32_t row : rows) own.push_back(ids()[landmark_of(row)]);
  const std::vector<std::int8_t> codes = rounded(rows);
  const auto search_two = [&](Codes queries, MatrixView<std::int64_t> ids,
                              MatrixView<std::int32_t> distances) {
    SearchOptions options;
    options.threads = threads;
    search_exact(view(), queries, options, ids, distances);
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
      cell = blocks().list_of({row});
    }
    return cell;
  };
  auto measured = std::make_shared<MeasuredRecall>();
  measured->table =
      measure_recall({codes.data(), rows.size(), dim()}, own, cells(), search_two, cell_of);
  measured->lists_version = cells_version();
  measured->changes = changes();
  const std::scoped_lock writing(ranks_mutex_);
  ranks_ = std::move(measured);
}

}  // namespace protomark
