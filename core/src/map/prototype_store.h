// What an open map holds in memory: landmarks, and rows, one for each prototype.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <shared_mutex>
#include <span>
#include <utility>
#include <vector>

#include "base/fair_shared_mutex.h"
#include "base/id_index.h"
#include "base/large_vector.h"
#include "file/journal.h"
#include "map/changes.h"
#include "protomark/prototypes.h"
#include "search/coarse_quantizer.h"
#include "search/list_blocks.h"
#include "search/recall.h"

namespace protomark {

// Of landmarks that have no position.
inline constexpr Position kNowhere = {std::numeric_limits<double>::quiet_NaN(),
                                      std::numeric_limits<double>::quiet_NaN(),
                                      std::numeric_limits<double>::quiet_NaN()};
bool is_nowhere(const Position& position);

// Neither landmarks nor rows are sorted. Without looks a row is a landmark and has its number; with
// them, the rows of a landmark are a chain.
//
// Rows stand in blocks by cell (ListBlocks): one without an index, else that of their rounded
// prototype. Row numbers that no row has are padding. Numbers of landmarks and rows hold until one
// goes or `settle` is called: others take the places of those that go.
class PrototypeStore {
 public:
  static constexpr std::uint32_t kNone = IdIndex::kNone;

  PrototypeStore(std::size_t dim, std::size_t look_bits) : dim_(dim), look_bits_(look_bits) {}

  std::size_t dim() const { return dim_; }
  std::size_t look_bits() const { return look_bits_; }
  std::size_t landmarks() const { return look_bits_ == 0 ? rows_ : ids_.size(); }
  std::size_t rows() const { return rows_; }
  // Of each landmark number, -1 where there is no landmark.
  const LargeVector<std::int64_t>& ids() const { return ids_; }
  // Row numbers are below.
  std::size_t places() const { return blocks_.blocks() * kPackedRows; }
  // What a place takes. Positions count where a landmark has one, as in a file: the same of equal
  // maps.
  std::size_t place_bytes() const;
  bool is_row(std::size_t place) const {
    return look_bits_ == 0 ? ids_[place] >= 0 : owners_[place] != kNone;
  }

  // Bit j is set where code[j] > 0, j < look_bits.
  std::uint16_t look_of(const std::int8_t* code) const;

  void reserve(std::size_t landmarks, std::size_t rows);
  // The landmark of an id, or kNone; `at` throws UnknownLandmark.
  std::uint32_t find(std::int64_t id) const { return index_.find(ids_, id); }
  std::uint32_t at(std::int64_t id) const;
  // The row of a landmark's look, or kNone.
  std::uint32_t find_row(std::uint32_t landmark, std::uint16_t look) const;
  std::uint32_t find_or_create_row(std::int64_t id, std::uint16_t look);
  // Take an id that is not there yet, and a look that the landmark does not have. A new landmark
  // needs a row at once; a new row has a sum and count of zero.
  std::uint32_t create_landmark(std::int64_t id);
  std::uint32_t create_row(std::uint32_t landmark, std::uint16_t look);
  // Afterwards the next create_row does not throw for want of memory.
  void make_room_for_row();
  // Room for so many landmarks and rows more in a change of `changed` rows, so that it takes no
  // time for that. Only reads the map, but within `alone(swap)`, which calls swap() while nobody
  // else reads.
  using Alone = std::function<void(const std::function<void()>& swap)>;
  void make_room(std::size_t landmarks, std::size_t rows, std::size_t changed, const Alone& alone);
  // Rows that were stepped over to find or renumber those of a landmark when others went.
  std::size_t steps() const { return steps_; }
  // With its last row a landmark leaves.
  void erase_row(std::uint32_t row);
  void erase(std::int64_t id);

  // Rows of a landmark, in no order: first_row, next_row of it and so on to kNone.
  std::uint32_t first_row(std::uint32_t landmark) const {
    return look_bits_ == 0 ? landmark : heads_[landmark];
  }
  std::uint32_t next_row(std::uint32_t row) const { return look_bits_ == 0 ? kNone : next_[row]; }
  std::uint32_t landmark_of(std::uint32_t row) const {
    return look_bits_ == 0 ? row : owners_[row];
  }
  std::uint16_t look(std::uint32_t row) const { return look_bits_ == 0 ? 0 : looks_[row]; }

  // Number of a landmark's rows, and of observations in them.
  std::size_t rows_of(std::uint32_t landmark) const;
  std::uint32_t observations(std::uint32_t landmark) const;

  // Hand over all landmarks by id, or the rows of a cell by id and then look, a piece at a time
  // (sorted_pieces.h).
  using Visit = std::function<void(std::span<const std::uint32_t>)>;
  void visit_sorted_landmarks(const Visit& visit) const;
  void visit_sorted_rows(std::uint32_t cell, const Visit& visit) const;
  // Landmarks by id.
  std::vector<std::uint32_t> sorted_landmarks() const;
  // The rows of these ranks among all rows by id and then look.
  std::vector<std::uint32_t> rows_at(std::span<const std::size_t> ranks) const;
  // Rows of some landmarks, in their order and then by look.
  std::vector<std::uint32_t> sorted_rows(std::span<const std::uint32_t> landmarks) const;
  // Rows of one landmark by look.
  std::vector<std::uint32_t> sorted_rows(std::uint32_t landmark) const;

  std::int16_t* sum(std::uint32_t row) { return &sums_[row * dim_]; }
  const std::int16_t* sum(std::uint32_t row) const { return &sums_[row * dim_]; }
  std::uint8_t count(std::uint32_t row) const { return counts_[row]; }
  void set_count(std::uint32_t row, int count) { counts_[row] = static_cast<std::uint8_t>(count); }
  std::int8_t rounded(std::uint32_t row, std::size_t d) const {
    return packed()[packed_index(row, d, dim_)];
  }
  // The rounded prototype of a row.
  void rounded(std::uint32_t row, std::int8_t* to) const;
  // The rounded prototypes of some rows, (rows x dim).
  std::vector<std::int8_t> rounded(std::span<const std::uint32_t> rows) const;

  // The rows of these landmarks' codes, kNone where there is none yet.
  void find_rows(std::span<const std::int64_t> landmarks, Codes codes,
                 std::span<std::uint32_t> rows) const;
  // Eq. 2 for one code after the other, with new landmarks and rows where there are none yet;
  // rounded means follow. `rows` are those that find_rows found.
  void add(std::span<const std::int64_t> landmarks, Codes codes,
           std::span<const std::uint32_t> rows);
  // Adds another sum and count, and halves where the count does not fit.
  void join(std::uint32_t row, const std::int16_t* sum, int count);
  // The rounded mean follows the sum and count.
  void refresh(std::uint32_t row);

  // Coarse cells; none: there is no index.
  const CoarseQuantizer& cells() const { return cells_; }
  const ListBlocks& blocks() const { return blocks_; }
  // A number that every set of cells has for itself.
  std::size_t cells_version() const { return cells_version_; }
  // Where rows will stand by other cells.
  struct Arrangement {
    CoarseQuantizer cells;
    ListBlocks blocks;
    std::vector<std::uint32_t> to;  // of each place; kNone where no row stands

    std::size_t places() const { return blocks.blocks() * kPackedRows; }
  };
  // By these cells; none: drops the index.
  Arrangement arrange(CoarseQuantizer cells, int threads) const;
  // The same map so arranged; takes the arrangement's cells.
  PrototypeStore arranged(Arrangement& arrangement) const;
  // This map itself; needs `make_places` for it before, and uses up the arrangement.
  void rearrange(Arrangement& arrangement) noexcept;
  // Room for so many places in all, as make_room makes it.
  void make_places(std::size_t places, const Alone& alone);
  // Puts rows that were created or refreshed into their cells; ends every change.
  void settle(int threads);
  // A number that grows with each row that came, changed or went while there was an index.
  std::size_t changes() const { return changes_; }

  // Notes from now on what changes. Only whoever commits takes the notes, no change going on.
  void track_changes() { uncommitted_ = std::make_unique<Changes>(); }
  bool tracks_changes() const { return uncommitted_ != nullptr; }
  void forget_changes() { uncommitted_.reset(); }
  Changes& uncommitted() const { return *uncommitted_; }
  // Of the same map with other cells.
  void take_notes_of(PrototypeStore& other) {
    uncommitted_ = std::move(other.uncommitted_);
    if (uncommitted_) uncommitted_->cells = true;
  }

  void set_position(std::uint32_t landmark, const Position& position);
  void make_room_for_positions(const Alone& alone);
  Position position(std::uint32_t landmark) const;
  // Empty while no landmark has ever had one, else one for each landmark number.
  const std::vector<Position>& positions() const { return positions_; }

  PackedPrototypes view() const;

 private:
  // A row by what does not change when others go.
  struct Key {
    std::int64_t id;
    std::uint16_t look;
  };

  // What a place holds, apart from what leads to it: `id` and `position` without looks, with them
  // `look`, `owner` and `next`.
  struct Row {
    std::array<std::int16_t, 256> sum;
    std::array<std::int8_t, 256> rounded;
    Position position;
    std::int64_t id;
    std::uint32_t owner, next;
    std::uint16_t look;
    std::uint8_t count;
  };

  const std::int8_t* packed() const { return reinterpret_cast<const std::int8_t*>(packed_.data()); }
  std::int8_t* packed() { return reinterpret_cast<std::int8_t*>(packed_.data()); }
  void add(std::uint32_t row, const std::int8_t* code);
  // Inlined, as GCC leaves out calls of what does nothing but this.
  [[gnu::always_inline]] void prefetch_prototype(std::uint32_t place) const {
    __builtin_prefetch(sum(place), 1);
    __builtin_prefetch(sum(place) + dim_ - 1, 1);
    __builtin_prefetch(&counts_[place], 1);
    for (std::size_t d = 0; d < dim_; d += 4) {
      __builtin_prefetch(packed() + packed_index(place, d, dim_), 1);
    }
  }
  void read(std::uint32_t place, Row& row) const;
  void write(std::uint32_t place, const Row& row);
  void vacate(std::uint32_t place);
  void prefetch(std::uint32_t place) const;
  void permute(std::vector<std::uint32_t>& to);
  void renumber_rows(const std::vector<std::uint32_t>& to);
  void adopt(Arrangement& arrangement);
  template <typename Do>
  void for_each_array(std::size_t landmarks, std::size_t places, const Do& todo);
  std::uint32_t* link_to(std::uint32_t row);
  std::uint32_t take_place(std::uint32_t cell);
  void resize_rows(std::size_t places);
  void relocate(std::uint32_t from, std::uint32_t to);
  void close_gap(std::uint32_t row);
  void erase_landmark(std::uint32_t landmark);

  std::size_t dim_;
  std::size_t look_bits_;
  std::size_t rows_ = 0;

  LargeVector<std::int64_t> ids_;
  std::vector<Position> positions_;
  IdIndex index_;
  std::vector<std::uint32_t> heads_;  // first row; empty without looks

  // By place.
  LargeVector<std::int16_t> sums_;  // rows x dim
  std::vector<std::uint8_t> counts_;
  LargeVector<CodeVector> packed_;     // rounded means, see PackedPrototypes
  std::vector<std::uint16_t> looks_;   // empty without looks
  std::vector<std::uint32_t> owners_;  // landmark of a row; empty without looks
  std::vector<std::uint32_t> next_;    // row of the same landmark; empty without looks

  ListBlocks blocks_;
  CoarseQuantizer cells_;
  std::size_t cells_version_ = 0;
  std::vector<Key> unsettled_;
  std::size_t changes_ = 0;
  std::size_t steps_ = 0;
  std::unique_ptr<Changes> uncommitted_;  // nullptr: nobody commits
};

// What users do not see of an open map.
//
// Two locks, so that a search waits for nothing but a piece of a change. A change holds `changing`
// alone from its first look at the map to its end, and `mutex` alone while it writes, a piece at a
// time. What reads the map for long (save, seal, the other map of an update) shares `changing`,
// searches and short questions share `mutex`. Who needs both takes `changing` first.
struct PrototypeMap::Store : PrototypeStore {
  // Observations or landmarks of a change that searches wait for.
  static constexpr std::size_t kPiece = 1 << 11;

  using PrototypeStore::PrototypeStore;

  // Calls change(begin, end) for pieces of [0, n), each alone with the map. The caller holds
  // `changing`, as that of make_room and put_into_cells.
  template <typename Change>
  void in_pieces(std::size_t n, const Change& change) {
    for (std::size_t begin = 0; begin < n; begin += kPiece) {
      const std::unique_lock lock(mutex);
      change(begin, std::min(n, begin + kPiece));
      settle(1);
    }
  }
  void add_in_pieces(std::span<const std::int64_t> landmarks, Codes codes, int threads);
  void make_room(std::size_t landmarks, std::size_t rows, std::size_t changed);
  void make_room_for_positions();
  CoarseQuantizer learn_cells(std::size_t number, int threads) const;
  // Rows go by these cells: beside the map, which takes as much memory again, or within it, which
  // takes 5 bytes a place and, where arrays have to grow, the largest of them once more, but lets
  // searches wait.
  void put_into_cells(CoarseQuantizer cells, int threads, bool in_place);

  // As measured on the map, now or when it was much the same; where others measure or change the
  // map, with these cells at least. `lock` is one of `mutex`, and is let go while ranks are
  // measured.
  std::shared_ptr<const MeasuredRecall> ranks(std::shared_lock<FairSharedMutex>& lock,
                                              double recall, int threads) const;

  void set_metadata(Metadata texts) {
    if (tracks_changes()) uncommitted().metadata |= texts != metadata;
    metadata = std::move(texts);
  }
  Metadata metadata;
  mutable FairSharedMutex changing, mutex;
  // Of the journal; before the other two.
  std::mutex journal_mutex;
  std::unique_ptr<Journal> journal;  // nullptr: there is none
  // The map file whose journal this is or was; empty where it never had one. Needs no lock, as it
  // never changes once others have the map.
  std::filesystem::path journaled;

 private:
  void alone(const std::function<void()>& swap);
  bool is_stale(const MeasuredRecall& ranks) const;
  void measure(int threads, bool wait) const;

  mutable std::mutex measuring_;    // before `changing`
  mutable std::mutex ranks_mutex_;  // last
  mutable std::shared_ptr<const MeasuredRecall> ranks_;
};

}  // namespace protomark
