// Measures on a map how many inverted lists a recall takes.
#pragma once

#include "protomark/search.h"
#include "search/coarse_quantizer.h"

namespace protomark {

// For each of some test queries, how many lists a search visits until it finds the nearest
// landmark; ascending.
using RecallTable = std::vector<std::uint32_t>;

struct MeasuredRecall {
  RecallTable table;
  std::size_t lists_version = 0;
  std::size_t changes = 0;
};

// Returns at most kTestQueries of `rows` as test queries, evenly spread.
inline constexpr std::size_t kTestQueries = 2048;
std::vector<std::size_t> test_rows(std::size_t rows);

// Finds the k nearest landmarks of each query exactly.
using ExactSearch = std::function<Matches(Codes, std::size_t k)>;
// The list of the prototype of a landmark that is nearest to a query.
using ListOf = std::function<std::uint32_t(std::int64_t landmark, const std::int8_t* query)>;

// Measures with two kinds of test queries: prototypes of the map, of the landmarks `owners`, search
// for another landmark, as keypoints do whose landmark is not in the map; and codes as far from
// these as observations are search for any landmark, which is harder in a dense map. For each share
// of the queries the larger number counts.
RecallTable measure_recall(Codes prototypes, const std::vector<std::int64_t>& owners,
                           const CoarseQuantizer& quantizer, const ExactSearch& search,
                           const ListOf& list_of);

// Returns how many lists to search for a recall above 0 and at most 1; all of them for 1.
std::size_t nprobe_for(const RecallTable& table, double recall, std::size_t nlist);

// Throws std::invalid_argument unless a map of `nlist` lists can be searched with this recall, or
// with these options. `remedy` says what to do if there are no lists.
void check_recall(double recall, std::size_t nlist, const char* remedy);
void check_lists(const SearchOptions& options, std::size_t nlist, const char* remedy);

}  // namespace protomark
