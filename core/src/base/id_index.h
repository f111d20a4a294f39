// A hash table from landmark ids to indices, of 4 bytes per slot: the caller keeps the ids.
#pragma once

#include <random>
#include <span>

#include "base/large_vector.h"
#include "base/rows.h"

namespace protomark {

// Open addressing with linear probing, at most two thirds full, no tombstones. The order of slots
// differs from process to process, so no result may depend on it.
class IdIndex {
 public:
  using Ids = LargeVector<int64_t>;  // the array that indices point into

  LandmarkIndex find(const Ids& ids, int64_t id) const {
    return slots_.empty() ? kNoLandmark : slots_[slot_of(ids, id)];
  }
  size_t probe_length(const Ids& ids, int64_t id) const {
    return slots_.empty() ? 0 : ((slot_of(ids, id) - home(id)) & mask()) + 1;
  }

  // Prefetch what `find` will read: first the slot and, once that has come, the ids to compare.
  void prefetch_slot(int64_t id) const {
    if (!slots_.empty()) __builtin_prefetch(&slots_[home(id)]);
  }
  void prefetch_ids(const Ids& ids, int64_t id) const {
    if (slots_.empty()) return;
    for (size_t s = home(id); slots_[s] != kNoLandmark; s = next(s)) {
      __builtin_prefetch(&ids[slots_[s].value]);
    }
  }

  bool has_room(size_t more) const { return fits(more, slots_.size()); }
  // Returns a copy with room for `more` further ids.
  IdIndex with_room(const Ids& ids, size_t more) const {
    IdIndex result;
    result.used_ = used_;
    size_t size = std::max<size_t>(16, slots_.size());
    while (!fits(more, size)) size *= 2;
    result.slots_.assign(size, kNoLandmark);
    for (const LandmarkIndex index : slots_) {
      if (index != kNoLandmark) result.put(ids, index);
    }
    return result;
  }
  void make_room(const Ids& ids, size_t more) {
    if (!has_room(more)) *this = with_room(ids, more);
  }
  // Inserts an index whose id is not in the table yet.
  void insert(const Ids& ids, LandmarkIndex index) {
    make_room(ids, 1);
    put(ids, index);
    ++used_;
  }
  void move(const Ids& ids, int64_t id, LandmarkIndex to) { slots_[slot_of(ids, id)] = to; }
  // Gives every index i the new value to[i].
  void renumber(std::span<const Row> to) {
    for (LandmarkIndex& index : slots_) {
      if (index != kNoLandmark) index.value = to[index.value].value;
    }
  }
  // Removes an id that is in the table and still in `ids`.
  void erase(const Ids& ids, int64_t id) {
    size_t hole = slot_of(ids, id);
    // Each entry up to the next gap moves back unless the hole is before its home.
    for (size_t s = next(hole); slots_[s] != kNoLandmark; s = next(s)) {
      const size_t from = home(ids[slots_[s].value]);
      if (((s - from) & mask()) >= ((s - hole) & mask())) {
        slots_[hole] = slots_[s];
        hole = s;
      }
    }
    slots_[hole] = kNoLandmark;
    --used_;
  }

 private:
  bool fits(size_t more, size_t slots) const { return 3 * (used_ + more) <= 2 * slots; }
  size_t mask() const { return slots_.size() - 1; }
  size_t next(size_t s) const { return (s + 1) & mask(); }

  // SplitMix64 (Steele et al. 2014): neighbouring ids end far apart.
  size_t home(int64_t id) const {
    auto x = static_cast<uint64_t>(id) + seed_;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return static_cast<size_t>(x ^ (x >> 31)) & mask();
  }

  // Returns the slot of the id, or the free one at which the search for it ends.
  size_t slot_of(const Ids& ids, int64_t id) const {
    size_t s = home(id);
    while (slots_[s] != kNoLandmark && ids[slots_[s].value] != id) s = next(s);
    return s;
  }

  void put(const Ids& ids, LandmarkIndex index) {
    size_t s = home(ids[index.value]);
    while (slots_[s] != kNoLandmark) s = next(s);
    slots_[s] = index;
  }

  LargeVector<LandmarkIndex> slots_;
  size_t used_ = 0;
  uint64_t seed_ = [] {
    // Each process draws its own, so that nobody can write a file whose ids all hash to one slot.
    static const uint64_t seed = uint64_t{std::random_device()()} << 32 | std::random_device()();
    return seed;
  }();
};

class IdSet {
 public:
  bool empty() const { return ids_.empty(); }
  bool contains(int64_t id) const { return index_.find(ids_, id) != kNoLandmark; }
  const LargeVector<int64_t>& ids() const { return ids_; }

  // Leaves the set as it was if memory runs out.
  void insert(int64_t id) {
    if (contains(id)) return;
    index_.make_room(ids_, 1);
    ids_.push_back(id);
    index_.insert(ids_, landmark_at(ids_.size() - 1));
  }

 private:
  LargeVector<int64_t> ids_;
  IdIndex index_;
};

}  // namespace protomark
