// The landmarks of a learning map, with a row for each prototype.
#pragma once

#include "base/bytes.h"
#include "base/large_vector.h"
#include "base/quantize.h"
#include "base/rows.h"
#include "map/positions.h"
#include "search/coarse_quantizer.h"
#include "search/list_blocks.h"

namespace protomark {

// The changes of a map since its last commit.
struct Uncommitted {
  bool empty() const { return !centroids && !metadata && landmarks.empty() && !incomplete; }
  // Never throws, so that every change is noted.
  void insert(int64_t id) noexcept try { landmarks.insert(id); } catch (const std::bad_alloc&) {
    incomplete = true;
  }
  void insert(const Uncommitted& other) noexcept {
    for (const int64_t id : other.landmarks.ids()) insert(id);
    centroids |= other.centroids;
    metadata |= other.metadata;
    incomplete |= other.incomplete;
  }

  IdSet landmarks;  // that were added, changed or removed
  bool centroids = false, metadata = false;
  bool incomplete = false;  // memory ran out, so that some ids are missing
};

// Rows are in blocks by inverted list: all in one without an index, otherwise each in the list of
// its rounded prototype. Padding fills the last block of a list.
//
// A row keeps its rounded prototype p, which search reads, its count n, and what is left of its
// sum, sum - n * p: numbers of -n / 2 to n / 2, in 4 bits up to n = 15, else in 8.
class PrototypeStore : public RowTable {
 public:
  // Names a row, whose index changes when others are removed.
  struct Key {
    int64_t id;
    uint16_t appearance;

    friend auto operator<=>(const Key&, const Key&) = default;
  };

  PrototypeStore(size_t dim, size_t appearance_bits)
      : RowTable(appearance_bits != 0),
        dim_(dim),
        appearance_bits_(appearance_bits),
        rest_bytes_((dim + 7) / 8 * 4),
        slots_(2 * rest_bytes_) {}

  size_t dim() const { return dim_; }
  size_t appearance_bits() const { return appearance_bits_; }
  bool several() const { return several_; }
  size_t landmark_count() const { return several_ ? ids_.size() : prototype_count_; }
  size_t prototype_count() const { return prototype_count_; }
  size_t row_end() const { return lists_.blocks() * kPackedRows; }  // with padding
  // Bytes per row of few observations, the same in equal maps.
  size_t row_bytes() const {
    return rest_bytes_ + packed_dim(dim_) + sizeof(counts_[0]) + RowTable::row_bytes();
  }

  // Returns the appearance of a code: bit j is set if code[j] > 0, j < appearance_bits.
  uint16_t appearance_of(const int8_t* code) const {
    unsigned signs = 0;
    for (size_t j = 0; j < appearance_bits_; ++j) signs |= (code[j] > 0 ? 1u : 0u) << j;
    return static_cast<uint16_t>(signs);
  }

  void reserve(size_t landmarks, size_t rows) {
    // One more block, as take_row wants one to be free.
    const size_t blocks = packed_blocks(rows) + 1;
    for_each_array(landmarks, blocks * kPackedRows,
                   [](auto& v, size_t n, const auto&) { v.reserve(n); });
    lists_.reserve(blocks);
  }
  // Makes room for more landmarks and rows in a change of `changed` rows. Others may read
  // meanwhile, as `searching` is held only to swap arrays.
  void make_room(size_t landmarks, size_t rows, size_t changed, FairSharedMutex& searching);
  void make_room_for_positions(FairSharedMutex& searching) {
    if (!positions_.empty()) return;
    std::vector<Position> fresh(ids_.size(), kNoPosition);
    const std::unique_lock lock(searching);
    positions_.swap(fresh);
  }

  // Creates a row, with a sum and count of zero, for an appearance that its landmark lacks;
  // kNoLandmark becomes a new landmark. If memory runs out nothing has changed.
  Row create_row(int64_t id, LandmarkIndex& landmark, uint16_t appearance) {
    if (landmark == kNoLandmark) make_room_for_landmark();
    const Row row = take_row(0);
    if (landmark != kNoLandmark) {
      add_row(landmark, row, appearance);
    } else {
      add_landmark(id, row, appearance);
      landmark = owner(row);
    }
    return row;
  }
  void erase_row(Row row) {
    if (uncommitted) uncommitted->insert(id(owner(row)));
    if (has_slot(row)) slots_.give_back(slot(row));
    remove_row(row);
    close_gap(row);
  }
  void erase(int64_t id) {
    for (size_t left = row_count(at(id)); left > 0; --left) erase_row(first_row(at(id)));
  }

  uint32_t observations(LandmarkIndex landmark) const {
    uint32_t n = 0;
    each_row_of(landmark, [&](Row row) { n += counts_[row.value]; });
    return n;
  }
  MapSummary summary() const {
    MapSummary result;
    each_landmark([&](LandmarkIndex l) {
      result.observations += observations(l);
      ++result.count_histogram[std::min(observations(l), 255u)];
      add_to_summary(result, position(l));
    });
    return result;
  }
  Key key(Row row) const { return {id(owner(row)), appearance(row)}; }
  int count(Row row) const { return counts_[row.value]; }
  Sum sum(Row row) const;
  // Fetches what `sum` and `set` access. Inlined, as GCC drops calls that do nothing but this.
  [[gnu::always_inline]] void prefetch(Row row) const {
    __builtin_prefetch(rest(row), 1);
    __builtin_prefetch(rest(row) + rest_bytes_ - 1, 1);
    __builtin_prefetch(&counts_[row.value], 1);
    for (size_t d = 0; d < dim_; d += 4) {
      __builtin_prefetch(packed() + packed_index(row.value, d, dim_), 1);
    }
  }
  // Replaces the sum and count of a row. If memory runs out, never for a new row, nothing changes.
  void set(Row row, const Sum& sum, int count);
  void rounded(Row row, int8_t* to) const {
    for (size_t d = 0; d < dim_; d += 4) {
      std::copy_n(packed() + packed_index(row.value, d, dim_), std::min<size_t>(4, dim_ - d),
                  to + d);
    }
  }
  // Copies it to row i of other packed prototypes.
  void copy_packed(Row row, void* to, size_t i) const {
    for (size_t d = 0; d < dim_; d += 4) {
      std::memcpy(static_cast<int8_t*>(to) + packed_index(i, d, dim_),
                  packed() + packed_index(row.value, d, dim_), 4);
    }
  }
  Matrix<int8_t> rounded(std::span<const Row> rows) const {
    Matrix<int8_t> result(rows.size(), dim_);
    for (size_t i = 0; i < rows.size(); ++i) rounded(rows[i], result.row(i));
    return result;
  }

  // These come in no order.
  void each_landmark(const auto& take) const {
    for (LandmarkIndex l{0}; l.value < ids_.size(); ++l.value) {
      if (id(l) >= 0) take(l);
    }
  }
  void each_row(const auto& take) const {
    for (Row row{0}; row.value < row_end(); ++row.value) {
      if (is_row(row)) take(row);
    }
  }
  // Visits all landmarks by ascending id, piece by piece, in 5 bits of memory per landmark.
  void visit_sorted_landmarks(
      const std::function<void(std::span<const LandmarkIndex>)>& visit) const;
  std::vector<Row> sorted_rows_of_list(uint32_t list) const {
    std::vector<Row> result;
    result.reserve(lists_.rows(list));
    lists_.each_row(list, [&](Row row) { result.push_back(row); });
    std::ranges::sort(result, {}, [&](Row row) { return key(row); });
    return result;
  }
  std::vector<LandmarkIndex> sorted_landmarks() const {
    std::vector<LandmarkIndex> result;
    result.reserve(landmark_count());
    visit_sorted_landmarks(
        [&](auto piece) { result.insert(result.end(), piece.begin(), piece.end()); });
    return result;
  }
  // Returns the rows that are n-th among all by key.
  std::vector<Row> sorted_rows_at(std::span<const size_t> n) const;

  void find_rows(std::span<const Key> keys, std::span<Row> rows) const;
  // Applies Eq. 2 code by code, to rows that find_rows found and, where it found none, to new ones.
  void add(std::span<const Key> keys, Codes codes, std::span<const Row> rows);
  // Adds another sum and count, and halves the result if the count is too large.
  void merge(Row row, const Sum& sum, int count);
  // Merges a landmark of a store, perhaps this one, into one with an id, existing or new.
  void merge(int64_t id, const PrototypeStore& from, LandmarkIndex landmark) {
    LandmarkIndex into = find(id);
    const std::vector<Row> rows = into == kNoLandmark ? std::vector<Row>() : sorted_rows(into);
    auto existing = rows.begin();
    for (const Row other : from.sorted_rows(landmark)) {
      const uint16_t wanted = from.appearance(other);
      while (existing != rows.end() && appearance(*existing) < wanted) ++existing;
      const bool found = existing != rows.end() && appearance(*existing) == wanted;
      const Row row = found ? *existing : create_row(id, into, wanted);
      merge(row, from.sum(other), from.count(other));
    }
    if (!has_position(position(into))) set_position(into, from.position(landmark));
  }
  // Puts rows that were created or set into their lists; ends every change.
  void reassign(int threads);

  void set_position(LandmarkIndex landmark, const Position& position) {
    RowTable::set_position(landmark, position);
    if (uncommitted) uncommitted->insert(id(landmark));
  }

  // Has no lists without an index.
  const CoarseQuantizer& quantizer() const { return quantizer_; }
  const ListBlocks& lists() const { return lists_; }
  // The rows by other centroids.
  struct Arrangement {
    CoarseQuantizer quantizer;
    ListBlocks lists;
    std::vector<Row> to;  // new row of each row; kNoRow for padding
  };
  Arrangement arrange(CoarseQuantizer quantizer, int threads) const;
  // Learns centroids from prototypes by id, so that they do not depend on the history of the map.
  CoarseQuantizer learn_quantizer(size_t nlist, int threads) const;
  // Moves rows and takes the centroids. After make_room_for it cannot run out of memory.
  void rearrange(Arrangement arrangement);
  void make_room_for(const Arrangement& arrangement, FairSharedMutex& searching) {
    // One more block is for rows while they move.
    const size_t blocks = std::max(lists_.blocks(), arrangement.lists.blocks()) + 1;
    for_each_array(0, blocks * kPackedRows,
                   [&](auto& v, size_t n, const auto&) { enlarge(v, n, searching); });
  }

  // Grows with each new set of centroids.
  size_t lists_version() const { return lists_version_; }
  // Grows with each row that was added, changed or removed while there was an index.
  size_t changes() const { return changes_; }
  // What to commit; nullptr without a journal. A commit takes it while no change is going on.
  std::shared_ptr<Uncommitted> uncommitted;

  PackedPrototypes view() const {
    PackedPrototypes result{packed(), row_end(), dim_};
    result.landmarks.ids = ids_.data();
    if (several_) result.landmarks.of_row = owners_.data();
    return result;
  }

 private:
  const int8_t* packed() const { return reinterpret_cast<const int8_t*>(packed_.data()); }
  int8_t* packed() { return reinterpret_cast<int8_t*>(packed_.data()); }
  // The 4-bit numbers of a row: the low and high bits of byte d % 4 of each 4 bytes are numbers d
  // and d + 4 of each 8. Or the slot of its 8-bit ones.
  const uint8_t* rest(Row row) const { return &rests_[row.value * rest_bytes_]; }
  uint8_t* rest(Row row) { return &rests_[row.value * rest_bytes_]; }
  bool has_slot(Row row) const { return counts_[row.value] > kMaxSmallCount; }
  uint32_t slot(Row row) const { return load<uint32_t>(rest(row)); }
  [[gnu::always_inline]] void prefetch_slot(Row row) const {
    if (!has_slot(row)) return;
    __builtin_prefetch(slots_[slot(row)], 1);
    __builtin_prefetch(slots_[slot(row)] + 2 * rest_bytes_ - 1, 1);
  }
  void add(Row row, const int8_t* codes, size_t n);
  Row take_row(uint32_t list);
  void resize(size_t rows) {
    for_each_array(ids_.size(), rows,
                   [](auto& v, size_t n, const auto& padding) { v.resize(n, padding); });
  }
  void copy_row(Row from, Row to);  // but not what leads to it
  void vacate(Row row) {
    for_each_plain_array(0, 1, [&](auto& v, size_t width, const auto& padding) {
      std::fill_n(v.data() + row.value * width, width, padding);
    });
  }
  void relocate(Row from, Row to) {
    relink(from, to);
    copy_row(from, to);
    vacate(from);
  }
  void close_gap(Row row);
  void permute(std::vector<Row>& to, Row spare);

  // Add the arrays of this class, without and with the packed one, in which rows are interleaved.
  void for_each_plain_array(size_t landmarks, size_t rows, const auto& visit) {
    RowTable::for_each_array(landmarks, rows, visit);
    visit(rests_, rows * rest_bytes_, uint8_t{0});
    visit(counts_, rows, uint8_t{0});
  }
  void for_each_array(size_t landmarks, size_t rows, const auto& visit) {
    for_each_plain_array(landmarks, rows, visit);
    visit(packed_, packed_size(rows, dim_) / sizeof(CodeVector), CodeVector{});
  }

  static constexpr int kMaxSmallCount = 15;

  size_t dim_;
  size_t appearance_bits_;
  size_t rest_bytes_;
  size_t prototype_count_ = 0;

  // By row.
  LargeVector<uint8_t> rests_;  // rows x rest_bytes_
  std::vector<uint8_t> counts_;
  LargeVector<CodeVector> packed_;  // rounded prototypes, as PackedPrototypes has them

  Slots slots_;
  ListBlocks lists_;
  CoarseQuantizer quantizer_;
  size_t lists_version_ = 0;
  std::vector<Key> to_reassign_;
  size_t changes_ = 0;
};

}  // namespace protomark
