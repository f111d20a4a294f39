// Rows of an open map go by other cells.
#include <algorithm>
#include <utility>

#include "map/prototype_store.h"

namespace protomark {
namespace {

// Rows that are put into cells at a time.
constexpr std::size_t kChunk = 1 << 14;

}  // namespace

PrototypeStore::Arrangement PrototypeStore::arrange(CoarseQuantizer cells, int threads) const {
  std::vector<std::uint32_t> cell_of(places(), ListOrder::kNone), rows;
  rows.reserve(std::min(rows_, kChunk));
  for (std::uint32_t place = 0; place < places(); ++place) {
    if (is_row(place)) rows.push_back(place);
    if (rows.size() < kChunk && place + 1 < places()) continue;
    std::vector<std::uint32_t> own(rows.size(), 0);
    if (cells.nlist() != 0) {
      const std::vector<std::int8_t> codes = rounded(rows);
      own = cells.assign({codes.data(), rows.size(), dim_}, threads);
    }
    for (std::size_t i = 0; i < rows.size(); ++i) cell_of[rows[i]] = own[i];
    rows.clear();
  }
  const std::size_t number_of_cells = std::max<std::size_t>(cells.nlist(), 1);
  ListOrder order(std::move(cell_of), number_of_cells);

  Arrangement result{std::move(cells), ListBlocks(number_of_cells), std::move(order.new_rows)};
  result.blocks.reserve(order.first_blocks.back());
  for (std::uint32_t c = 0; c < number_of_cells; ++c) {
    for (std::size_t i = 0; i < order.sizes[c]; ++i) result.blocks.append(c);
  }
  return result;
}

PrototypeStore PrototypeStore::arranged(Arrangement& arrangement) const {
  const std::vector<std::uint32_t>& to = arrangement.to;
  PrototypeStore result(dim_, look_bits_);
  result.rows_ = rows_;
  result.changes_ = changes_;
  result.cells_version_ = cells_version_;
  result.index_ = index_;
  if (look_bits_ == 0) {
    if (!positions_.empty()) result.positions_.assign(arrangement.places(), kNowhere);
  } else {
    result.ids_ = ids_;
    result.positions_ = positions_;
    result.heads_ = heads_;
  }
  result.resize_rows(arrangement.places());
  Row row;
  for (std::uint32_t place = 0; place < to.size(); ++place) {
    if (to[place] == kNone) continue;
    read(place, row);
    result.write(to[place], row);
  }
  result.renumber_rows(to);
  result.adopt(arrangement);
  return result;
}

void PrototypeStore::rearrange(Arrangement& arrangement) noexcept {
  const ListBlocks& blocks = arrangement.blocks;
  renumber_rows(arrangement.to);
  resize_rows(std::max(places(), arrangement.places()));
  permute(arrangement.to);
  Row padding{};
  padding.position = kNowhere;
  padding.id = -1;
  padding.owner = padding.next = kNone;
  for (std::uint32_t c = 0; c < blocks.nlist(); ++c) {
    if (blocks.rows(c) == 0) continue;
    for (std::uint32_t place = blocks.last(c).value + 1; place % kPackedRows != 0; ++place) {
      write(place, padding);
    }
  }
  resize_rows(arrangement.places());
  adopt(arrangement);
}

// Moves every row to its place, and uses up `to`. A row goes where another one stands, which goes
// on in its turn, until one comes to a place that is free. In a large map nearly all of that would
// wait for memory, so it is asked for ahead.
void PrototypeStore::permute(std::vector<std::uint32_t>& to) {
  constexpr int kAhead = 8;
  // Where the row at a place goes, or kNone where none stands that has yet to move.
  const auto next = [&](std::uint32_t place) { return place < to.size() ? to[place] : kNone; };
  Row rows[2];
  for (std::uint32_t first = 0; first < to.size(); ++first) {
    if (to[first] == kNone || to[first] == first) continue;
    Row *moving = &rows[0], *met = &rows[1];
    read(first, *moving);
    std::uint32_t place = std::exchange(to[first], kNone), ahead = place;
    const auto look_ahead = [&] {
      if (ahead == kNone) return;
      prefetch(ahead);
      ahead = next(ahead);
    };
    for (int i = 0; i < kAhead; ++i) look_ahead();
    while (next(place) != kNone) {
      look_ahead();
      read(place, *met);
      write(place, *moving);
      std::swap(moving, met);
      place = std::exchange(to[place], kNone);
    }
    write(place, *moving);
  }
}

void PrototypeStore::prefetch(std::uint32_t place) const {
  prefetch_prototype(place);
  if (look_bits_ == 0) {
    __builtin_prefetch(&ids_[place], 1);
    if (!positions_.empty()) __builtin_prefetch(&positions_[place], 1);
  } else {
    __builtin_prefetch(&looks_[place], 1);
    __builtin_prefetch(&owners_[place], 1);
    __builtin_prefetch(&next_[place], 1);
  }
}

// What leads to rows, where `to` says where they go.
void PrototypeStore::renumber_rows(const std::vector<std::uint32_t>& to) {
  if (look_bits_ == 0) return index_.renumber(to);
  for (auto* links : {&heads_, &next_}) {
    for (std::uint32_t& row : *links) {
      if (row != kNone) row = to[row];
    }
  }
}

void PrototypeStore::adopt(Arrangement& arrangement) {
  std::swap(cells_, arrangement.cells);
  std::swap(blocks_, arrangement.blocks);
  ++cells_version_;
  changes_ += rows_;
  if (uncommitted_) uncommitted_->cells = true;
}

}  // namespace protomark
