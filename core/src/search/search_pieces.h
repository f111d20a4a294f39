// How a search is divided among threads.
#pragma once

#include <algorithm>
#include <cstddef>

namespace protomark {

// Queries are divided first, as those of a piece share the work on each row that does not depend
// on the query; where they are too few for all threads, rows are divided as well.
class SearchPieces {
 public:
  struct Range {
    std::size_t begin;
    std::size_t end;
    std::size_t size() const { return end - begin; }
  };

  SearchPieces(int threads, std::size_t queries, std::size_t rows)
      : queries_(queries), rows_(rows) {
    if (threads <= 1 || queries == 0) return;
    const auto n = static_cast<std::size_t>(threads);
    query_pieces_ = std::min(4 * n, divide_up(queries, kPieceQueries));
    row_pieces_ = std::min(divide_up(n, query_pieces_), divide_up(rows, kPieceRows));
    row_pieces_ = std::max<std::size_t>(row_pieces_, 1);
  }

  std::size_t query_pieces() const { return query_pieces_; }
  std::size_t row_pieces() const { return row_pieces_; }
  Range queries(std::size_t i) const { return range(queries_, 16, i, query_pieces_); }
  Range rows(std::size_t i) const { return range(rows_, 16, i, row_pieces_); }

 private:
  static constexpr std::size_t kPieceQueries = 64;
  static constexpr std::size_t kPieceRows = 4096;

  static std::size_t divide_up(std::size_t a, std::size_t b) { return (a + b - 1) / b; }
  static Range range(std::size_t n, std::size_t grain, std::size_t i, std::size_t pieces) {
    const std::size_t grains = divide_up(n, grain);
    return {std::min(n, grains * i / pieces * grain),
            std::min(n, grains * (i + 1) / pieces * grain)};
  }

  std::size_t queries_;
  std::size_t rows_;
  std::size_t query_pieces_ = 1;
  std::size_t row_pieces_ = 1;
};

}  // namespace protomark
