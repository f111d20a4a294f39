// Chooses how a map is sealed: numbers of a prototype, their words, and which prototypes, tuned.
#pragma once

#include "map/prototype_store.h"
#include "protomark/encoder.h"

namespace protomark {

struct SealFormat {
  size_t dim;                // numbers of a prototype
  const Codebook* codebook;  // of its words; nullptr: numbers are int8
  size_t row_limit;          // prototypes in all
};

// Chooses the format for a number of bytes per landmark (SealOptions); `observed` says whether
// observations will tune the prototypes. Throws std::invalid_argument, with the smallest possible
// number, for less.
SealFormat seal_format(const PrototypeStore& store, const Encoder& encoder,
                       std::optional<double> bytes_per_landmark, bool observed);

// Returns the bytes that prototypes of `row_bytes` and their number take.
size_t sealed_bytes(size_t landmarks, size_t rows, size_t row_bytes);

// Returns the bits of a row's owner, which is a landmark or, for padding, the number of landmarks.
int owner_bits(size_t landmarks);

// Merges prototype `source` into prototype `into`, which precedes it and keeps its index.
struct AppearanceMerge {
  double cost;
  uint16_t into;
  uint16_t source;
};

// Returns all merges that make one prototype of several, at each step the one of least cost (Ward
// 1963), ties to the first rows. `sums` is (rows x dim), `counts` (rows), at most 65536 rows. Of
// more than 2048 rows, neighbours are merged first, at no cost.
std::vector<AppearanceMerge> appearance_merges(std::span<const int16_t> sums,
                                               std::span<const uint8_t> counts, size_t dim);

// Merges appearances until there are at most `limit` rows (SealFormat), and 255 of any landmark, by
// the first `dim` numbers. Returns a store of these numbers of the prototypes, in lists of the
// centroids cut to `dim`, or nullopt if the store is that already. A prototype of more than 255
// observations has its rounded mean as sum, and a count of one.
std::optional<PrototypeStore> merge_appearances(const PrototypeStore& store, size_t dim,
                                                size_t limit);

// What prototypes are tuned by: codes, each of a landmark and standing for `weight` observations.
struct TuningQueries {
  // Takes the appearances of a learning map, cut to `dim` numbers.
  TuningQueries(const PrototypeStore& map, size_t dim);
  // Takes observations, cut to `dim` numbers.
  TuningQueries(std::span<const int64_t> ids, Codes observed, size_t dim)
      : landmarks(ids.begin(), ids.end()), codes(ids.size(), dim), weights(ids.size(), uint8_t{1}) {
    for (size_t i = 0; i < ids.size(); ++i) std::copy_n(observed.row(i), dim, codes.row(i));
  }

  std::vector<int64_t> landmarks;  // ids; queries of others than the map's are ignored
  Matrix<int8_t> codes;
  std::vector<uint8_t> weights;
};

// Returns the store with prototypes tuned as docs/design.md says, each as the sum of one
// observation. Equal stores and queries, in any order, give equal prototypes on every machine.
PrototypeStore tune_prototypes(const PrototypeStore& store, const TuningQueries& queries,
                               int threads);

}  // namespace protomark
