// Measures on a map how many inverted lists a recall takes.
#pragma once

#include "protomark/search.h"
#include "search/coarse_quantizer.h"

namespace protomark {

// For each of some test queries, how many lists a search visits until it finds the nearest
// landmark; ascending.
using RecallTable = std::vector<uint32_t>;

struct MeasuredRecall {
  RecallTable table;
  size_t lists_version = 0;
  size_t changes = 0;
};

// Returns at most kTestQueries of `rows` as test queries, evenly spread.
inline constexpr size_t kTestQueries = 2048;
std::vector<size_t> test_rows(size_t rows);

// Finds the k nearest landmarks of each query exactly.
using ExactSearch = std::function<Matches(Codes, size_t k)>;
// The list of the prototype of a landmark that is nearest to a query.
using ListOf = std::function<uint32_t(int64_t landmark, const int8_t* query)>;

// Measures with two kinds of test queries: prototypes of the map, of the landmarks `owners`, search
// for another landmark, as keypoints do whose landmark is not in the map; and codes as far from
// these as observations are search for any landmark, which is harder in a dense map. For each share
// of the queries the larger number counts.
RecallTable measure_recall(Codes prototypes, const std::vector<int64_t>& owners,
                           const CoarseQuantizer& quantizer, const ExactSearch& search,
                           const ListOf& list_of);

// Returns how many lists to search for a recall above 0 and at most 1; all of them for 1.
size_t nprobe_for(const RecallTable& table, double recall, size_t nlist);

// Throws std::invalid_argument unless a map of `nlist` lists can be searched with this recall, or
// with these options. `remedy` says what to do if there are no lists.
void check_recall(double recall, size_t nlist, const char* remedy);
void check_lists(const SearchOptions& options, size_t nlist, const char* remedy);

}  // namespace protomark
