// Landmark id -> row, 4 bytes a slot: the slots hold rows, the ids stay in the map's own array.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <random>
#include <vector>

#include "base/large_vector.h"

namespace protomark {

// Of this process: ids come from files, and nobody can choose them so that all want one slot.
inline std::uint64_t hash_seed() {
  static const std::uint64_t seed = [] {
    std::random_device random;
    return std::uint64_t{random()} << 32 | random();
  }();
  return seed;
}

// Open addressing with linear probing, at most two thirds full, no tombstones. Which slot a row is
// in differs from process to process; nothing that is given out may depend on it.
class IdIndex {
 public:
  static constexpr std::uint32_t kNone = UINT32_MAX;

  // The row of `id`, or kNone. `ids` is the array that rows point into.
  std::uint32_t find(const LargeVector<std::int64_t>& ids, std::int64_t id) const {
    return slots_.empty() ? kNone : slots_[slot_of(ids, id)];
  }
  // Slots that `find` looks at.
  std::size_t probes(const LargeVector<std::int64_t>& ids, std::int64_t id) const {
    return slots_.empty() ? 0 : ((slot_of(ids, id) - home(id)) & mask()) + 1;
  }

  // Ask for the memory that `find` will read: first its slot, and when that has come, the ids that
  // it may compare.
  void prefetch_slot(std::int64_t id) const {
    if (!slots_.empty()) __builtin_prefetch(&slots_[home(id)]);
  }
  void prefetch_ids(const LargeVector<std::int64_t>& ids, std::int64_t id) const {
    if (slots_.empty()) return;
    for (std::size_t s = home(id); slots_[s] != kNone; s = next(s)) {
      __builtin_prefetch(&ids[slots_[s]]);
    }
  }

  bool has_room(std::size_t more) const { return 3 * (used_ + more) <= 2 * slots_.size(); }
  // The same index with room for as many ids more.
  IdIndex with_room(const LargeVector<std::int64_t>& ids, std::size_t more) const {
    IdIndex result;
    result.used_ = used_;
    std::size_t size = std::max<std::size_t>(16, slots_.size());
    while (3 * (used_ + more) > 2 * size) size *= 2;
    result.slots_.assign(size, kNone);
    for (const std::uint32_t row : slots_) {
      if (row != kNone) result.place(ids, row);
    }
    return result;
  }

  // Takes a row whose id is not there yet.
  void insert(const LargeVector<std::int64_t>& ids, std::uint32_t row) {
    if (!has_room(1)) *this = with_room(ids, 1);
    place(ids, row);
    ++used_;
  }

  // Changes the row of an id that is there.
  void move(const LargeVector<std::int64_t>& ids, std::int64_t id, std::uint32_t to) {
    slots_[slot_of(ids, id)] = to;
  }

  // All rows change; `to` has the new one of each.
  void renumber(const std::vector<std::uint32_t>& to) {
    for (std::uint32_t& row : slots_) {
      if (row != kNone) row = to[row];
    }
  }

  // Removes an id that is there; `ids` must still hold it.
  void erase(const LargeVector<std::int64_t>& ids, std::int64_t id) {
    std::size_t hole = slot_of(ids, id);
    // Close the gap: whatever follows without a break and may stand in the hole moves back.
    for (std::size_t s = next(hole); slots_[s] != kNone; s = next(s)) {
      const std::size_t wanted = home(ids[slots_[s]]);
      if (((s - wanted) & mask()) >= ((s - hole) & mask())) {
        slots_[hole] = slots_[s];
        hole = s;
      }
    }
    slots_[hole] = kNone;
    --used_;
  }

 private:
  std::size_t mask() const { return slots_.size() - 1; }
  std::size_t next(std::size_t s) const { return (s + 1) & mask(); }

  // SplitMix64 (Steele et al. 2014): neighbouring ids end far apart.
  std::size_t home(std::int64_t id) const {
    auto x = static_cast<std::uint64_t>(id) + seed_;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return static_cast<std::size_t>(x ^ (x >> 31)) & mask();
  }

  // Of the id, or the free one where the search for it ends.
  std::size_t slot_of(const LargeVector<std::int64_t>& ids, std::int64_t id) const {
    std::size_t s = home(id);
    while (slots_[s] != kNone && ids[slots_[s]] != id) s = next(s);
    return s;
  }

  void place(const LargeVector<std::int64_t>& ids, std::uint32_t row) {
    std::size_t s = home(ids[row]);
    while (slots_[s] != kNone) s = next(s);
    slots_[s] = row;
  }

  LargeVector<std::uint32_t> slots_;
  std::size_t used_ = 0;
  std::uint64_t seed_ = hash_seed();
};

}  // namespace protomark
