// Answers of a learning map, its index, and search.
#include "protomark/prototype_map.h"

#include "map/map_state.h"
#include "search/inverted_lists.h"

namespace protomark {
namespace {

// Writes the mean of all observations in some rows.
void write_mean(const PrototypeStore& store, std::span<const Row> rows, float* mean) {
  std::array<int64_t, 256> sums{};
  int64_t n = 0;
  for (const Row row : rows) {
    const Sum sum = store.sum(row);
    for (size_t d = 0; d < store.dim(); ++d) sums[d] += sum[d];
    n += store.count(row);
  }
  for (size_t d = 0; d < store.dim(); ++d) {
    mean[d] = static_cast<float>(static_cast<double>(sums[d]) / static_cast<double>(n));
  }
}

auto values_of(MapState& state, std::span<const int64_t> ids, const auto& value_of) {
  const std::shared_lock lock(state.searching);
  std::vector<decltype(value_of(LandmarkIndex{}))> result;
  for (const int64_t id : ids) result.push_back(value_of(state.store.at(id)));
  return result;
}

std::unique_ptr<MapState> make_state(std::shared_ptr<const Encoder> encoder, size_t dim,
                                     size_t appearance_bits) {
  require(encoder != nullptr, "a map needs an encoder");
  if (dim == 0) dim = encoder->dim();
  require(std::ranges::find(encoder->dims(), dim) != encoder->dims().end(), "encoder '",
          encoder->info().name, "' has no codes of ", dim, " dimensions");
  const size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  require(appearance_bits <= limit, "appearance_bits must be 0 to ", limit, ", not ",
          appearance_bits);
  return std::make_unique<MapState>(std::move(encoder), dim, appearance_bits);
}

// The recall table is measured again once this part of the rows has changed.
constexpr size_t kStalePart = 10;

// Returns which of `rows` rows are test queries. Multiples of the golden ratio are evenly spread,
// but not in step with the rows from which lists are learned.
std::vector<size_t> test_rows(size_t rows) {
  std::vector<size_t> result(std::min(rows, kTestQueries));
  for (size_t i = 0; i < result.size(); ++i) {
    const uint64_t x = (i + 1) * uint64_t{0x9e3779b97f4a7c15};
    result[i] = static_cast<size_t>((x >> 32) * rows >> 32);
  }
  return result;
}

// Moves codes about as far as observations are from their prototypes, by 0.4 of the difference of
// two others, which has 0.32 times the variance of all codes; observations have 0.2 to 0.5 times.
Matrix<int8_t> like_observations(Codes codes) {
  Matrix<int8_t> result(codes.rows, codes.columns);
  for (size_t i = 0; i < codes.rows; ++i) {
    const int8_t* a = codes.row((i + 1) % codes.rows);
    const int8_t* b = codes.row((i + 2) % codes.rows);
    for (size_t d = 0; d < codes.columns; ++d) {
      const int moved = codes.row(i)[d] + 2 * (a[d] - b[d]) / 5;
      result.row(i)[d] = static_cast<int8_t>(std::clamp(moved, -127, 127));
    }
  }
  return result;
}

// `owners`, if there are any, are landmarks that the queries must not find.
RecallTable measure(const PrototypeStore& store, Codes queries, std::span<const int64_t> owners,
                    const std::function<void(int8_t*)>& stored, const ExactSearch& search) {
  const size_t n = queries.rows, dim = queries.columns;
  const Matrix<int64_t> ids = search(queries).ids;
  // By landmark, as one may have many prototypes.
  std::vector<std::pair<int64_t, size_t>> nearest;
  for (size_t q = 0; q < n; ++q) {
    // If others are as near, the owner may be second, or not among the two.
    const bool is_owner = !owners.empty() && ids.row(q)[0] == owners[q];
    if (const int64_t id = ids.row(q)[is_owner ? 1 : 0]; id >= 0) nearest.emplace_back(id, q);
  }
  std::ranges::sort(nearest);
  // The list of the prototype that a query searches for, and the distance of its centroid.
  const PreparedCodes prepared(queries);
  std::vector<uint32_t> lists(n);
  std::vector<int32_t> limits(n, INT32_MIN);
  int64_t last = -1;
  std::vector<Row> rows;
  Matrix<int8_t> prototypes;
  for (const auto& [id, q] : nearest) {
    if (std::exchange(last, id) != id) {
      rows = store.sorted_rows(store.at(id));
      prototypes = store.rounded(rows);
      for (size_t i = 0; i < rows.size(); ++i) stored(prototypes.row(i));
    }
    std::pair<int32_t, size_t> best{INT32_MAX, 0};
    for (size_t i = 0; i < rows.size(); ++i) {
      best = std::min(best, {squared_distance(queries.row(q), prototypes.row(i), dim), i});
    }
    lists[q] = store.lists().list_of(rows[best.second]);
    const int8_t* centroid = store.quantizer().centroids().row(lists[q]);
    limits[q] = squared_distance(centroid, queries.row(q), dim) - prepared.norms()[q];
  }
  RecallTable table(n, 0);  // counts the lists up to that one
  const PackedPrototypes centroids = store.quantizer().packed();
  CodeScan(prepared, {0, n})
      .compare(
          static_cast<const int8_t*>(centroids.data), centroids.rows,
          [&](size_t q) { return limits[q]; },
          [&](size_t q, int32_t distance, size_t list) {
            if (distance < limits[q] || list <= lists[q]) ++table[q];
          });
  std::erase(table, 0u);
  std::ranges::sort(table);
  return table;
}

}  // namespace

PrototypeMap::PrototypeMap(std::shared_ptr<const Encoder> encoder, size_t dim,
                           size_t appearance_bits)
    : PrototypeMap(make_state(std::move(encoder), dim, appearance_bits)) {}
PrototypeMap::PrototypeMap(std::unique_ptr<MapState> state) : state_(std::move(state)) {}
PrototypeMap::PrototypeMap(PrototypeMap&& other) noexcept = default;
PrototypeMap::~PrototypeMap() = default;

const std::shared_ptr<const Encoder>& PrototypeMap::encoder() const { return state_->encoder; }
size_t PrototypeMap::dim() const { return state_->store.dim(); }
size_t PrototypeMap::appearance_bits() const { return state_->store.appearance_bits(); }

size_t PrototypeMap::size() const {
  const std::shared_lock lock(state_->searching);
  return state_->store.landmark_count();
}

size_t PrototypeMap::prototype_count() const {
  const std::shared_lock lock(state_->searching);
  return state_->store.prototype_count();
}

std::vector<int64_t> PrototypeMap::ids() const {
  std::vector<int64_t> result;
  {
    const std::shared_lock lock(state_->searching);
    result.reserve(state_->store.landmark_count());
    std::ranges::copy_if(state_->store.ids(), std::back_inserter(result),
                         [](int64_t id) { return id >= 0; });
  }
  std::ranges::sort(result);
  return result;
}

Metadata PrototypeMap::metadata() const {
  const std::shared_lock lock(state_->searching);
  return state_->metadata;
}

std::vector<Position> PrototypeMap::positions(std::span<const int64_t> ids) const {
  return values_of(*state_, ids, [&](LandmarkIndex l) { return state_->store.position(l); });
}

std::vector<uint32_t> PrototypeMap::counts(std::span<const int64_t> ids) const {
  return values_of(*state_, ids, [&](LandmarkIndex l) { return state_->store.observations(l); });
}

Matrix<float> PrototypeMap::prototypes(std::span<const int64_t> ids) const {
  const PrototypeStore& store = state_->store;
  Matrix<float> means(ids.size(), dim());
  const std::shared_lock lock(state_->searching);
  for (size_t i = 0; i < ids.size(); ++i) {
    write_mean(store, store.sorted_rows(store.at(ids[i])), means.row(i));
  }
  return means;
}

Matrix<float> PrototypeMap::appearances(int64_t id) const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->searching);
  const std::vector<Row> rows = store.sorted_rows(store.at(id));
  Matrix<float> means(rows.size(), dim());
  for (size_t i = 0; i < rows.size(); ++i) write_mean(store, {&rows[i], 1}, means.row(i));
  return means;
}

std::vector<int32_t> PrototypeMap::distances(std::span<const int64_t> ids, Codes codes) const {
  require(codes.rows == ids.size() && codes.columns == dim(), ids.size(),
          " landmarks need as many codes of ", dim(), " numbers, not ", codes.rows, " of ",
          codes.columns);
  const PrototypeStore& store = state_->store;
  std::vector<int32_t> result(ids.size(), INT32_MAX);
  std::vector<int8_t> prototype(dim());
  const std::shared_lock lock(state_->searching);
  for (size_t i = 0; i < ids.size(); ++i) {
    store.each_row_of(store.at(ids[i]), [&](Row row) {
      store.rounded(row, prototype.data());
      result[i] = std::min(result[i], squared_distance(codes.row(i), prototype.data(), dim()));
    });
  }
  return result;
}

std::vector<uint32_t> PrototypeMap::appearance_counts(int64_t id) const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->searching);
  std::vector<uint32_t> result;
  for (const Row row : store.sorted_rows(store.at(id))) {
    result.push_back(static_cast<uint32_t>(store.count(row)));
  }
  return result;
}

MapSummary PrototypeMap::summary() const {
  const std::shared_lock lock(state_->changing);
  return state_->store.summary();
}

void PrototypeMap::build_index(const IndexOptions& options, int threads) {
  require(threads >= 1, "threads must be at least 1");
  MapChange change(*state_);
  const PrototypeStore& store = state_->store;
  const size_t rows = store.prototype_count();
  require(rows != 0, "a map without landmarks has nothing to index");
  const size_t nlist =
      options.nlist.value_or(CoarseQuantizer::default_nlist(rows, store.dim(), store.row_bytes()));
  const size_t limit = std::min(rows, CoarseQuantizer::kMaxLists);
  require(nlist >= 1 && nlist <= limit, "nlist must be 1 to ", limit, " for this map, not ", nlist);
  change.set_quantizer(store.learn_quantizer(nlist, threads), threads, options.in_place);
}

void PrototypeMap::drop_index() { MapChange(*state_).set_quantizer({}, 1, false); }

void MapChange::set_quantizer(CoarseQuantizer quantizer, int threads, bool in_place) {
  PrototypeStore& store = state_->store;
  auto arrangement = store.arrange(std::move(quantizer), threads);
  if (in_place) {
    store.make_room_for(arrangement, state_->searching);
    const auto lock = write();
    store.rearrange(std::move(arrangement));
    return;
  }
  PrototypeStore other = store;
  other.rearrange(std::move(arrangement));
  const auto lock = write();
  std::swap(store, other);  // after the lock is released the old one is freed
}

size_t PrototypeMap::nlist() const {
  const std::shared_lock lock(state_->searching);
  return state_->store.quantizer().nlist();
}

size_t PrototypeMap::nprobe(double recall, int threads) const {
  std::shared_lock lock(state_->searching);
  return state_->nprobe(lock, recall, threads);
}

Matches PrototypeMap::search_codes(Codes queries, size_t k, const SearchOptions& options) const {
  std::shared_lock lock(state_->searching);
  const PrototypeStore& store = state_->store;
  check_lists(options, store.quantizer().nlist(), kBuildIndex);
  size_t nprobe = options.nprobe.value_or(SIZE_MAX);
  if (options.recall) nprobe = state_->nprobe(lock, *options.recall, options.threads);
  const auto append = [&](LandmarkIndex landmark, std::vector<Row>& rows) {
    store.each_row_of(landmark, [&](Row row) { rows.push_back(row); });
  };
  const LandmarkRows landmarks{store.ids().size(), [&](auto id) { return store.at(id); }, append};
  return search_map(store.view(), InvertedLists(store.lists()), store.quantizer().packed(),
                    landmarks, nprobe, queries, k, options);
}

RecallTable measure_recall(const PrototypeStore& store, const std::function<void(int8_t*)>& stored,
                           const ExactSearch& search) {
  const std::vector<Row> rows = store.sorted_rows_at(test_rows(store.prototype_count()));
  std::vector<int64_t> owners;
  for (const Row row : rows) owners.push_back(store.id(store.owner(row)));
  const Matrix<int8_t> prototypes = store.rounded(rows);
  const RecallTable others = measure(store, prototypes, owners, stored, search);
  RecallTable table = measure(store, like_observations(prototypes), {}, stored, search);
  // A map with a single landmark has no others.
  for (size_t i = 0; i < others.size(); ++i) table[i] = std::max(table[i], others[i]);
  return table;
}

size_t MapState::nprobe(std::shared_lock<FairSharedMutex>& lock, double recall, int threads) {
  for (bool tried = false;; tried = true) {
    const size_t nlist = store.quantizer().nlist();
    check_recall(recall, nlist, kBuildIndex);
    std::shared_ptr<const MeasuredRecall> measured;
    {
      const std::scoped_lock reading(recall_mutex);
      measured = recall_table;
    }
    const bool of_these = measured && measured->lists_version == store.lists_version();
    if (of_these && (tried || !is_stale(*measured))) {
      return nprobe_for(measured->table, recall, nlist);
    }
    lock.unlock();
    measure(threads, !of_these);
    lock.lock();
  }
}

bool MapState::is_stale(const MeasuredRecall& table) const {
  return table.lists_version != store.lists_version() ||
         (store.changes() - table.changes) * kStalePart >= store.prototype_count();
}

// Does nothing without `wait` if others measure or change the map.
void MapState::measure(int threads, bool wait) {
  std::unique_lock alone(measuring, std::defer_lock);
  std::shared_lock unchanged(changing, std::defer_lock);
  if (wait) {
    alone.lock();
    unchanged.lock();
  } else if (!alone.try_lock() || !unchanged.try_lock()) {
    return;
  }
  if (store.quantizer().nlist() == 0 || (recall_table && !is_stale(*recall_table))) return;
  const auto search = [&](Codes queries) {
    return search_exact(store.view(), queries, 2, {.threads = threads});
  };
  auto measured = std::make_shared<const MeasuredRecall>(MeasuredRecall{
      measure_recall(store, [](int8_t*) {}, search), store.lists_version(), store.changes()});
  const std::scoped_lock writing(recall_mutex);
  recall_table = std::move(measured);
}

}  // namespace protomark
