// Tells how many inverted lists to search for a recall, as measured on a map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "protomark/search.h"
#include "search/coarse_quantizer.h"

namespace protomark {

// For each of some test queries, how many lists had to be searched until its nearest landmark was
// found; ascending.
using RecallTable = std::vector<std::uint32_t>;

// The table of a learning map, with the version of its lists and the changes up to then.
struct MeasuredRecall {
  RecallTable table;
  std::size_t lists_version = 0;
  std::size_t changes = 0;
};

// Returns at most kTestQueries of `rows`, evenly spread, that serve as test queries.
inline constexpr std::size_t kTestQueries = 2048;
std::vector<std::size_t> test_rows(std::size_t rows);

// Finds the two nearest landmarks of each query exactly.
using SearchTwo = std::function<Matches(Codes)>;
// The list of the prototype of a landmark that is nearest to a query.
using ListOf = std::function<std::uint32_t(std::int64_t landmark, const std::int8_t* query)>;

// Asks two kinds of test queries. Prototypes of the map, of the landmarks `owners`, look for the
// nearest prototype of another landmark, as keypoints do whose landmark is not in the map. Codes as
// far from these prototypes as observations are look for any landmark, which is harder in a dense
// map. Of each share the larger number counts.
RecallTable measure_recall(Codes prototypes, const std::vector<std::int64_t>& owners,
                           const CoarseQuantizer& quantizer, const SearchTwo& search_two,
                           const ListOf& list_of);

// Returns how many lists to search for a recall above 0 and at most 1; all of them for 1.
std::size_t nprobe_for(const RecallTable& table, double recall, std::size_t nlist);

// Throws std::invalid_argument unless a map of `nlist` lists can be searched with this recall, or
// with these options. `remedy` says what to do if there are no lists.
void check_recall(double recall, std::size_t nlist, const char* remedy);
void check_lists(const SearchOptions& options, std::size_t nlist, const char* remedy);

}  // namespace protomark
