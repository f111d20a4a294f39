// How many cells have to be searched for a recall, as measured on a map.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "protomark/search.h"

namespace protomark {

// For each of some test queries the rank of the cell in which its nearest landmark is, 1 for the
// cell nearest to the query; ascending.
using ProbeRanks = std::vector<std::uint32_t>;

// Ranks of an open map, and of which cells and after how many changes.
struct MeasuredRanks {
  ProbeRanks ranks;
  std::size_t cells_version = 0;
  std::size_t changes = 0;
};

// Rows of a map that are taken as test queries: evenly spread over `rows`, at most kTestQueries.
inline constexpr std::size_t kTestQueries = 2048;
std::vector<std::size_t> test_rows(std::size_t rows);

// Finds the two nearest landmarks of each query exactly.
using SearchTwo = std::function<void(Codes, MatrixView<std::int64_t>, MatrixView<float>)>;
// The cell of the prototype of a landmark that is nearest to a query.
using CellOf = std::function<std::uint32_t(std::int64_t landmark, const std::int8_t* query)>;

// Test queries are of two kinds: prototypes of the map itself, which look for the nearest prototype
// of another landmark (own[i] is the landmark of prototype i), as keypoints do whose landmark is
// not in the map; and codes as far from these prototypes as observations are, which look for any,
// and in a dense map find it harder. The greater rank of each share counts.
ProbeRanks measure_ranks(Codes prototypes, const std::vector<std::int64_t>& own,
                         const std::vector<std::int8_t>& centroids, const SearchTwo& search_two,
                         const CellOf& cell_of);

// Cells to search for a recall above 0 and at most 1; all of them for 1.
std::size_t probes_for(const ProbeRanks& ranks, double recall, std::size_t cells);

// Checks `recall` and `probes` of a search in a map of that many cells. nullopt: an exact search;
// else the number of cells to search, 0 where it depends on options.recall. `remedy` is what to do
// where there are no cells. Throws std::invalid_argument.
std::optional<std::size_t> asked_probes(const SearchOptions& options, std::size_t cells,
                                        const char* remedy);
void check_recall(double recall, std::size_t cells, const char* remedy);

// The options without these.
SearchOptions exact(const SearchOptions& options);

}  // namespace protomark
