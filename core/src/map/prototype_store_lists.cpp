// Puts the rows of a learning map into inverted lists.
#include <algorithm>
#include <utility>

#include "map/prototype_store.h"

namespace protomark {
namespace {

// Rows that are assigned to lists at a time, and those that are moved at a time.
constexpr std::size_t kAssignChunk = 1 << 14, kReassignChunk = 1 << 16;

}  // namespace

// Finds a row by its key again before moving it, as another move may have changed its index.
void PrototypeStore::reassign(int threads) {
  const auto find_key = [&](const Key& key) {
    const LandmarkIndex landmark = find(key.id);
    return landmark == kNoLandmark ? kNoRow : find_row(landmark, key.appearance);
  };
  std::vector<Key> keys;
  std::vector<Row> rows;
  for (std::size_t first = 0; first < to_reassign_.size(); first += kReassignChunk) {
    keys.clear();
    rows.clear();
    const std::size_t end = std::min(first + kReassignChunk, to_reassign_.size());
    for (std::size_t i = first; i < end; ++i) {
      const Row row = find_key(to_reassign_[i]);
      if (row == kNoRow) continue;
      keys.push_back(to_reassign_[i]);
      rows.push_back(row);
    }
    const std::vector<std::int8_t> codes = rounded(rows);
    auto lists = quantizer_.assign({codes.data(), rows.size(), dim_}, threads);
    std::size_t moving = 0;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (lists_.list_of(rows[i]) == lists[i]) continue;
      keys[moving] = keys[i];
      lists[moving++] = lists[i];
    }
    for (std::size_t i = 0; i < moving; ++i) {
      const Row row = find_key(keys[i]);
      if (lists_.list_of(row) == lists[i]) continue;  // its key came twice
      relocate(row, take_row(lists[i]));
      close_gap(row);
    }
  }
  changes_ += to_reassign_.size();
  to_reassign_.clear();
}

PrototypeStore::Arrangement PrototypeStore::arrange(CoarseQuantizer quantizer, int threads) const {
  const std::size_t nlist = std::max<std::size_t>(quantizer.nlist(), 1);
  std::vector<Row> list_of_row(row_end(), kNoRow);
  std::vector<Row> rows;
  rows.reserve(std::min(prototype_count_, kAssignChunk));
  const auto assign = [&] {
    std::vector<std::uint32_t> lists(rows.size(), 0);
    if (quantizer.nlist() != 0) {
      const std::vector<std::int8_t> codes = rounded(rows);
      lists = quantizer.assign({codes.data(), rows.size(), dim_}, threads);
    }
    for (std::size_t i = 0; i < rows.size(); ++i) list_of_row[rows[i].value].value = lists[i];
    rows.clear();
  };
  each_row([&](Row row) {
    rows.push_back(row);
    if (rows.size() == kAssignChunk) assign();
  });
  assign();
  ListOrder order(std::move(list_of_row), nlist);
  Arrangement result{std::move(quantizer), ListBlocks(nlist), std::move(order.new_rows)};
  result.lists.reserve(order.first_blocks.back());
  for (std::uint32_t list = 0; list < nlist; ++list) {
    for (std::uint32_t i = 0; i < order.sizes[list]; ++i) result.lists.append(list);
  }
  return result;
}

void PrototypeStore::make_room_for(const Arrangement& arrangement, FairSharedMutex& searching) {
  // One more block is for rows while they move.
  const std::size_t blocks = std::max(lists_.blocks(), arrangement.lists.blocks()) + 1;
  for_each_array(0, blocks * kPackedRows, [&](auto& v, std::size_t n, const auto&) {
    if (v.capacity() < n) enlarge(v, n, searching);
  });
}

void PrototypeStore::rearrange(Arrangement arrangement) {
  const ListBlocks& lists = arrangement.lists;
  const std::size_t end = std::max(lists_.blocks(), lists.blocks()) * kPackedRows;
  for_each_array(0, end + kPackedRows, [](auto& v, std::size_t n, const auto&) { v.reserve(n); });
  relink(arrangement.to);
  resize(end + kPackedRows);
  permute(arrangement.to, row_at(end));
  for (std::uint32_t list = 0; list < lists.nlist(); ++list) {
    if (lists.rows(list) == 0) continue;
    for (Row row{lists.last(list).value + 1}; row.value % kPackedRows != 0; ++row.value)
      vacate(row);
  }
  quantizer_ = std::move(arrangement.quantizer);
  lists_ = std::move(arrangement.lists);
  resize(row_end());
  ++lists_version_;
  changes_ += prototype_count_;
  if (uncommitted) uncommitted->centroids = true;
}

// Moves every row to to[row], and uses up `to`. A row that is there moves on in its turn, until one
// comes to padding; `spare` and the next row hold rows meanwhile. In a large map nearly all of this
// waits for memory, which is therefore prefetched.
void PrototypeStore::permute(std::vector<Row>& to, Row spare) {
  constexpr int kAhead = 8;
  // Where the row here goes; kNoRow if none has to leave.
  const auto next = [&](Row row) { return row.value < to.size() ? to[row.value] : kNoRow; };
  Row moving = spare, met{spare.value + 1};
  for (Row first{0}; first.value < to.size(); ++first.value) {
    if (to[first.value] == kNoRow || to[first.value] == first) continue;
    copy_row(first, moving);
    Row row = std::exchange(to[first.value], kNoRow), ahead = row;
    const auto prefetch_next = [&] {
      if (ahead == kNoRow) return;
      prefetch(ahead);
      RowTable::for_each_array(0, 1, [&](auto& v, std::size_t width, const auto&) {
        __builtin_prefetch(v.data() + ahead.value * width, 1);
      });
      ahead = next(ahead);
    };
    for (int i = 0; i < kAhead; ++i) prefetch_next();
    while (next(row) != kNoRow) {
      prefetch_next();
      copy_row(row, met);
      copy_row(moving, row);
      std::swap(moving, met);
      row = std::exchange(to[row.value], kNoRow);
    }
    copy_row(moving, row);
  }
}

}  // namespace protomark
