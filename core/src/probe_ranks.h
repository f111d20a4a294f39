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

// Rows of a map that are taken as test queries: evenly spread over `rows`, at most kTestQueries.
inline constexpr std::size_t kTestQueries = 2048;
std::vector<std::size_t> test_rows(std::size_t rows);

// Test queries are prototypes of the map itself, and what they look for is the nearest prototype of
// another landmark: own[i] is the landmark of query i. `search_two` finds the two nearest landmarks
// exactly, `cell_of` the cell of the prototype of a landmark that is nearest to a query.
ProbeRanks measure_ranks(
    Codes queries, const std::vector<std::int64_t>& own, const std::vector<std::int8_t>& centroids,
    const std::function<void(MatrixView<std::int64_t>, MatrixView<float>)>& search_two,
    const std::function<std::uint32_t(std::int64_t landmark, const std::int8_t* query)>& cell_of);

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
