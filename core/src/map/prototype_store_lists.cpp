// Puts the rows of a learning map into inverted lists.
#include <algorithm>
#include <utility>

#include "map/prototype_store.h"

namespace protomark {
namespace {

// Rows whose lists are looked up at a time, and those that are moved at a time.
constexpr std::size_t kAssignChunk = 1 << 14, kReassignChunk = 1 << 16;

}  // namespace

// A row is looked up by its key again before it moves, as its index may have changed when another
// one moved.
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
    auto lists = centroids_.assign({codes.data(), rows.size(), dim_}, threads);
    std::size_t moving = 0;
    for (std::size_t i = 0; i < rows.size(); ++i) {
      if (lists_.cell_of(rows[i].value) == lists[i]) continue;
      keys[moving] = keys[i];
      lists[moving++] = lists[i];
    }
    for (std::size_t i = 0; i < moving; ++i) {
      const Row row = find_key(keys[i]);
      if (lists_.cell_of(row.value) == lists[i]) continue;  // its key was there twice
      relocate(row, take_row(lists[i]));
      close_gap(row);
    }
  }
  changes_ += to_reassign_.size();
  to_reassign_.clear();
}

PrototypeStore::Arrangement PrototypeStore::arrange(Cells centroids, int threads) const {
  const std::size_t nlist = std::max<std::size_t>(centroids.size(), 1);
  std::vector<Row> to(row_end(), kNoRow);  // for now the list of each row
  std::vector<std::size_t> counts(nlist);
  std::vector<Row> rows;
  rows.reserve(std::min(prototype_count_, kAssignChunk));
  for (Row row{0}; row.value < row_end(); ++row.value) {
    if (is_row(row)) rows.push_back(row);
    if (rows.size() < kAssignChunk && row.value + 1 < row_end()) continue;
    std::vector<std::uint32_t> lists(rows.size(), 0);
    if (centroids.size() != 0) {
      const std::vector<std::int8_t> codes = rounded(rows);
      lists = centroids.assign({codes.data(), rows.size(), dim_}, threads);
    }
    for (std::size_t i = 0; i < rows.size(); ++i) {
      to[rows[i].value].value = lists[i];
      ++counts[lists[i]];
    }
    rows.clear();
  }
  Arrangement result{std::move(centroids), CellBlocks(nlist), std::move(to)};
  std::size_t blocks = 0;
  for (const std::size_t n : counts) blocks += (n + kPackedRows - 1) / kPackedRows;
  result.lists.reserve(blocks);
  std::vector<Row> next(nlist);  // of each list
  for (std::uint32_t list = 0; list < nlist; ++list) {
    next[list].value = static_cast<std::uint32_t>(result.row_end());
    for (std::size_t i = 0; i < counts[list]; ++i) result.lists.append(list);
  }
  for (Row& row : result.to) {
    if (row != kNoRow) row.value = next[row.value].value++;
  }
  return result;
}

PrototypeStore PrototypeStore::arranged(Arrangement& arrangement) const {
  const std::size_t rows = arrangement.row_end();
  PrototypeStore result(dim_, appearance_bits_);
  static_cast<RowTable&>(result) = with_rows(rows);
  result.prototype_count_ = prototype_count_;
  result.changes_ = changes_;
  result.centroids_version_ = centroids_version_;
  result.resize(rows);
  Record record;
  for (Row row{0}; row.value < row_end(); ++row.value) {
    const Row to = arrangement.to[row.value];
    if (to == kNoRow) continue;
    read(row, record);
    result.write(to, record);
  }
  result.renumber_rows(arrangement.to);
  result.adopt(arrangement);
  return result;
}

void PrototypeStore::rearrange(Arrangement& arrangement) noexcept {
  const CellBlocks& lists = arrangement.lists;
  renumber_rows(arrangement.to);
  resize(std::max(row_end(), arrangement.row_end()));
  permute(arrangement.to);
  for (std::uint32_t list = 0; list < lists.cells(); ++list) {
    if (lists.rows(list) == 0) continue;
    for (Row row{lists.last(list) + 1}; row.value % kPackedRows != 0; ++row.value) vacate(row);
  }
  resize(arrangement.row_end());
  adopt(arrangement);
}

// Moves every row to where it goes, and uses up `to`. A row that stands there goes on in its turn,
// until one comes to padding. In a large map nearly all of this waits for memory, so that is
// prefetched.
void PrototypeStore::permute(std::vector<Row>& to) {
  constexpr int kAhead = 8;
  // Where the row that stands here goes; kNoRow if none stands here that has yet to move.
  const auto next = [&](Row row) { return row.value < to.size() ? to[row.value] : kNoRow; };
  Record records[2];
  for (Row first{0}; first.value < to.size(); ++first.value) {
    if (to[first.value] == kNoRow || to[first.value] == first) continue;
    Record *moving = &records[0], *met = &records[1];
    read(first, *moving);
    Row row = std::exchange(to[first.value], kNoRow), ahead = row;
    const auto look_ahead = [&] {
      if (ahead == kNoRow) return;
      prefetch_prototype(ahead);
      RowTable::prefetch(ahead);
      ahead = next(ahead);
    };
    for (int i = 0; i < kAhead; ++i) look_ahead();
    while (next(row) != kNoRow) {
      look_ahead();
      read(row, *met);
      write(row, *moving);
      std::swap(moving, met);
      row = std::exchange(to[row.value], kNoRow);
    }
    write(row, *moving);
  }
}

void PrototypeStore::adopt(Arrangement& arrangement) {
  std::swap(centroids_, arrangement.centroids);
  std::swap(lists_, arrangement.lists);
  ++centroids_version_;
  changes_ += prototype_count_;
  if (uncommitted_) uncommitted_->centroids = true;
}

}  // namespace protomark
