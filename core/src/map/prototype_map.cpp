// Answers of a learning map, its index, and search.
#include "protomark/prototype_map.h"

#include "map/map_state.h"
#include "search/among.h"

namespace protomark {
namespace {

constexpr char kRemedy[] = "call build_index first";
// The recall table is measured again once this part of the rows has changed.
constexpr size_t kStalePart = 10;

float mean(int64_t sum, int64_t n) {
  return static_cast<float>(static_cast<double>(sum) / static_cast<double>(n));
}

std::unique_ptr<MapState> make_state(std::shared_ptr<const Encoder> encoder, size_t dim,
                                     size_t appearance_bits) {
  if (encoder == nullptr) invalid("a map needs an encoder");
  if (dim == 0) dim = encoder->dim();
  if (std::ranges::find(encoder->dims(), dim) == encoder->dims().end()) {
    invalid("encoder '", encoder->info().name, "' has no codes of ", dim, " dimensions");
  }
  const size_t limit = std::min(PrototypeMap::kMaxAppearanceBits, dim);
  if (appearance_bits > limit) {
    invalid("appearance_bits must be 0 to ", limit, ", not ", appearance_bits);
  }
  return std::make_unique<MapState>(std::move(encoder), dim, appearance_bits);
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
  const std::shared_lock lock(state_->searching);
  const PrototypeStore& store = state_->store;
  std::vector<Position> result;
  for (const int64_t id : ids) result.push_back(store.position(store.at(id)));
  return result;
}

std::vector<uint32_t> PrototypeMap::counts(std::span<const int64_t> ids) const {
  const std::shared_lock lock(state_->searching);
  const PrototypeStore& store = state_->store;
  std::vector<uint32_t> result;
  for (const int64_t id : ids) result.push_back(store.observations(store.at(id)));
  return result;
}

Matrix<float> PrototypeMap::prototypes(std::span<const int64_t> ids) const {
  const PrototypeStore& store = state_->store;
  Matrix<float> means(ids.size(), dim());
  std::vector<int64_t> sum(dim());
  const std::shared_lock lock(state_->searching);
  for (size_t i = 0; i < ids.size(); ++i) {
    std::ranges::fill(sum, 0);
    int64_t n = 0;
    for (Row row = store.first_row(store.at(ids[i])); row != kNoRow; row = store.next_row(row)) {
      const Sum own = store.sum(row);
      for (size_t d = 0; d < dim(); ++d) sum[d] += own[d];
      n += store.count(row);
    }
    for (size_t d = 0; d < dim(); ++d) means.row(i)[d] = mean(sum[d], n);
  }
  return means;
}

Matrix<float> PrototypeMap::appearances(int64_t id) const {
  const PrototypeStore& store = state_->store;
  const std::shared_lock lock(state_->searching);
  const std::vector<Row> rows = store.sorted_rows(store.at(id));
  Matrix<float> means(rows.size(), dim());
  for (size_t i = 0; i < rows.size(); ++i) {
    const Sum sum = store.sum(rows[i]);
    for (size_t d = 0; d < dim(); ++d) means.row(i)[d] = mean(sum[d], store.count(rows[i]));
  }
  return means;
}

std::vector<int32_t> PrototypeMap::distances(std::span<const int64_t> ids, Codes codes) const {
  if (codes.rows != ids.size() || codes.columns != dim()) {
    invalid(ids.size(), " landmarks need as many codes of ", dim(), " numbers, not ", codes.rows,
            " of ", codes.columns);
  }
  const PrototypeStore& store = state_->store;
  std::vector<int32_t> result(ids.size(), INT32_MAX);
  std::vector<int8_t> prototype(dim());
  const std::shared_lock lock(state_->searching);
  for (size_t i = 0; i < ids.size(); ++i) {
    for (Row row = store.first_row(store.at(ids[i])); row != kNoRow; row = store.next_row(row)) {
      store.rounded(row, prototype.data());
      result[i] = std::min(result[i], squared_distance(codes.row(i), prototype.data(), dim()));
    }
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
  if (threads < 1) invalid("threads must be at least 1");
  MapChange change(*state_);
  const PrototypeStore& store = state_->store;
  const size_t rows = store.prototype_count();
  if (rows == 0) invalid("a map without landmarks has nothing to index");
  const size_t nlist =
      options.nlist.value_or(CoarseQuantizer::default_nlist(rows, store.dim(), store.row_bytes()));
  const size_t limit = std::min(rows, CoarseQuantizer::kMaxLists);
  if (nlist < 1 || nlist > limit) {
    invalid("nlist must be 1 to ", limit, " for this map, not ", nlist);
  }
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

Matches PrototypeMap::search(Descriptors queries, size_t k, const SearchOptions& options) const {
  return search_codes(encoder()->encode(queries, dim(), options.threads), k, options);
}

Matches PrototypeMap::search_codes(Codes queries, size_t k, const SearchOptions& options) const {
  std::shared_lock lock(state_->searching);
  const PrototypeStore& store = state_->store;
  check_lists(options, store.quantizer().nlist(), kRemedy);
  size_t nprobe = options.nprobe.value_or(SIZE_MAX);
  if (options.recall) nprobe = state_->nprobe(lock, *options.recall, options.threads);
  const auto append = [&](LandmarkIndex landmark, std::vector<Row>& rows) {
    store.each_row_of(landmark, [&](Row row) { rows.push_back(row); });
  };
  const LandmarkRows landmarks{store.ids().size(), [&](auto id) { return store.at(id); }, append};
  return search_map(store.view(), InvertedLists(store.lists()), store.quantizer().packed(),
                    landmarks, nprobe, queries, k, options);
}

RecallTable measure_recall_of(const PrototypeStore& store,
                              const std::function<void(int8_t*)>& stored,
                              const ExactSearch& search) {
  const std::vector<Row> rows = store.sorted_rows_at(test_rows(store.prototype_count()));
  std::vector<int64_t> owners;
  for (const Row row : rows) owners.push_back(store.id(store.owner(row)));
  const std::vector<int8_t> codes = store.rounded(rows);
  // Those of the landmark that was asked for last, which may be one of many appearances.
  int64_t last = -1;
  std::vector<Row> own_rows;
  std::vector<int8_t> prototypes;
  const auto list_of = [&](int64_t id, const int8_t* query) {
    if (std::exchange(last, id) != id) {
      own_rows = store.sorted_rows(store.at(id));
      prototypes = store.rounded(own_rows);
      for (size_t i = 0; i < own_rows.size(); ++i) stored(&prototypes[i * store.dim()]);
    }
    uint32_t list = 0;
    int32_t least = INT32_MAX;
    for (size_t i = 0; i < own_rows.size(); ++i) {
      const int8_t* prototype = &prototypes[i * store.dim()];
      const int32_t distance = squared_distance(query, prototype, store.dim());
      if (distance >= least) continue;
      least = distance;
      list = store.lists().list_of(own_rows[i]);
    }
    return list;
  };
  return measure_recall({codes.data(), rows.size(), store.dim()}, owners, store.quantizer(), search,
                        list_of);
}

size_t MapState::nprobe(std::shared_lock<FairSharedMutex>& lock, double recall, int threads) {
  for (bool tried = false;; tried = true) {
    const size_t nlist = store.quantizer().nlist();
    check_recall(recall, nlist, kRemedy);
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
  auto measured = std::make_shared<MeasuredRecall>();
  measured->table = measure_recall_of(
      store, [](int8_t*) {},
      [&](Codes queries, size_t k) {
        return search_exact(store.view(), queries, k, {.threads = threads});
      });
  measured->lists_version = store.lists_version();
  measured->changes = store.changes();
  const std::scoped_lock writing(recall_mutex);
  recall_table = std::move(measured);
}

}  // namespace protomark
