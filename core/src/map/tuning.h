// Tunes prototypes against each other, so that fewer observations are nearer to another landmark.
#pragma once

#include "map/prototype_store.h"

namespace protomark {

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

// Returns the store with tuned prototypes, each as the sum of one observation. Equal stores and
// queries, in any order, give equal prototypes on every machine.
//
// This is learning vector quantization (Sato and Yamada 1996) with the softmax of prototypical
// networks (Snell et al. 2017): p_r is the softmax of -d(query, r) / T over the query's own
// prototype, without the query itself, and the ones near to it, d being squared distances and T a
// quarter of their mean to the own prototypes. Each pass moves the own prototype of n observations
// by 0.35 / (n + 2) (1 - p_own) (query - prototype), and the others by -0.35 / (n + 2) p_r (query -
// prototype).
PrototypeStore tune_prototypes(const PrototypeStore& store, const TuningQueries& queries,
                               int threads);

}  // namespace protomark
