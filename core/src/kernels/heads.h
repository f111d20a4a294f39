// When kernels look at heads (PackedCodes::head) first. Of internal linkage: each set of kernels is
// compiled with flags of its own.
#pragma once

#include "kernels.h"

namespace protomark::kernels {
namespace {

class Heads {
 public:
  Heads(const CodeQueries& queries, const PackedCodes& rows)
      : queries_(queries.n),
        never_(rows.biases == nullptr || rows.head >= rows.dim || queries.n < kTile),
        put_off_(queries.put_off) {
    for (std::size_t q = 0; q < queries_; ++q) {
      const std::int32_t limit = queries.limits[q], tail = queries.tails[q];
      limits_[q] = limit > INT32_MAX - tail ? INT32_MAX : limit + tail;
    }
  }

  // What |p|^2 - 2 p . q over the head does not exceed for rows within the limits: the other
  // dimensions add at least minus the squared norm of the query there.
  const std::int32_t* limits() const { return limits_; }

  // A look at heads pays where it leaves few queries; else it is put off for some steps.
  bool now() {
    if (never_) return false;
    if (*put_off_ == 0) return true;
    --*put_off_;
    return false;
  }
  void left(std::size_t queries) {
    if (queries * kMany > queries_) *put_off_ = kPutOff;
  }

 private:
  static constexpr std::size_t kTile = 4, kMany = 4, kPutOff = 15;

  std::size_t queries_;
  bool never_;
  std::size_t* put_off_;
  std::int32_t limits_[kScanQueries];
};

}  // namespace
}  // namespace protomark::kernels
