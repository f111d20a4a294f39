// Search in as many inverted lists as a recall takes, or among some landmarks.
#pragma once

#include "search/list_blocks.h"
#include "search/scan.h"

namespace protomark {

// A view of the blocks of each list, chained in a learning map, one after the other elsewhere.
class InvertedLists {
 public:
  explicit InvertedLists(const ListBlocks& chained) : chained_(&chained) {}
  // `rows` counts those of each list; `first_blocks` has the first block of each list, and the end.
  InvertedLists(std::span<const uint32_t> rows, std::span<const uint32_t> first_blocks)
      : rows_(rows), first_blocks_(first_blocks) {}

  size_t nlist() const { return chained_ != nullptr ? chained_->nlist() : rows_.size(); }
  size_t rows(uint32_t list) const {
    return chained_ != nullptr ? chained_->rows(list) : rows_[list];
  }
  // Replaces `blocks` by those of a list, in order, all full but the last one.
  void read(uint32_t list, std::vector<uint32_t>& blocks) const {
    blocks.clear();
    if (chained_ != nullptr) {
      chained_->append_blocks(list, blocks);
      std::reverse(blocks.begin(), blocks.end());
    } else {
      for (uint32_t b = first_blocks_[list]; b < first_blocks_[list + 1]; ++b) {
        blocks.push_back(b);
      }
    }
  }

 private:
  const ListBlocks* chained_ = nullptr;
  std::span<const uint32_t> rows_;
  std::span<const uint32_t> first_blocks_;
};

// Returns the indices of the centroids nearest to each query (queries x nprobe), ties to the
// smaller, the nearest first, the others in no order. `nprobe` is 1 to the number of centroids.
std::vector<uint32_t> nearest_lists(const PackedPrototypes& centroids, const PreparedCodes& queries,
                                    size_t nprobe, int threads);

// Searches as search_exact does, but only in the `nprobe` lists (at least 1) nearest to each query,
// ties to the smaller list; in all prototypes if there are no more. `centroids` are those of lists.
Matches search_lists(const PackedPrototypes& prototypes, const InvertedLists& lists,
                     const PackedPrototypes& centroids, size_t nprobe, Codes queries, size_t k,
                     const SearchOptions& options);

struct LandmarkRows {
  size_t end;  // all indices are below
  std::function<LandmarkIndex(int64_t id)> at;
  // Appends the rows of a landmark.
  std::function<void(LandmarkIndex, std::vector<Row>&)> append;
};

// Searches as search_lists does, but with options.among only the rows of these landmarks. They are
// packed anew, a piece at a time, and searched as a small map, at a cost that follows their number;
// or, where that is less work, all rows are compared and those of other landmarks are passed over.
// With options.recall as many lists are then searched as hold so many of these rows.
Matches search_map(PackedPrototypes prototypes, const InvertedLists& lists,
                   const PackedPrototypes& centroids, const LandmarkRows& landmarks, size_t nprobe,
                   Codes queries, size_t k, const SearchOptions& options);

// How many lists a search visits to find the nearest landmark of each test query; ascending.
using RecallTable = std::vector<uint32_t>;

inline constexpr size_t kTestQueries = 2048;  // at most

// Returns how many lists to search for a recall above 0 and at most 1; all of them for 1.
size_t nprobe_for(const RecallTable& table, double recall, size_t nlist);

// Throws std::invalid_argument unless a map of `nlist` lists can be searched with this recall, or
// with these options. `remedy` says what to do if there are no lists.
void check_recall(double recall, size_t nlist, const char* remedy);
void check_lists(const SearchOptions& options, size_t nlist, const char* remedy);

}  // namespace protomark
