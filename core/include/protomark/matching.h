// Matches of a frame with a map, each with the probability that it is right.
#pragma once

#include "protomark/encoder.h"
#include "protomark/prototype_map.h"
#include "protomark/sealed_map.h"
#include "protomark/types.h"

namespace protomark {

// The probability that the nearest landmark of a keypoint is the right one:
//   P = 1 / (1 + exp(-(w0 + w1 d^2 + w2 (s^2 - d^2))))
// d and s are the distances to the nearest and the second nearest landmark, 2 d without a second.
// `protomark calibrate` fits the weights for each encoder and length, mean or tuned prototypes.
struct PROTOMARK_API MatchCalibration {
  std::array<double, 3> weights{};  // w0, w1, w2

  // Reads the calibration for codes of `dim` numbers, 0 for the full length, and for the prototypes
  // of a map, which are tuned or not, from the encoder's notes. Throws std::invalid_argument if
  // there is none, or a note that cannot be read.
  static MatchCalibration of(const Encoder& encoder, size_t dim = 0, bool tuned = false);
  // Takes squared distances as a search gives them. Returns 0 where there is no nearest landmark.
  double probability(double nearest, double second) const;
  bool operator==(const MatchCalibration&) const = default;
};

// Match i is of keypoints[i] and landmarks[i]; the likeliest is first.
struct MatchList {
  std::vector<size_t> keypoints;      // rows of the descriptors, each at most once
  std::vector<int64_t> landmarks;     // ids, each at most once
  std::vector<double> probabilities;  // that the match is right
  size_t size() const { return keypoints.size(); }
  bool operator==(const MatchList&) const = default;
};

struct MatchOptions {
  // Of a match that is accepted, 0 to 1.
  double min_probability = 0.2;
  // As in SearchOptions.
  std::optional<double> recall = std::nullopt;
  std::optional<std::span<const int64_t>> among = std::nullopt;
  int threads = 1;
};

// Finds the landmarks that the keypoints of a frame see: for each descriptor the nearest landmark,
// if that is likely enough to be right. Throws as MatchCalibration::of and as search.
PROTOMARK_API MatchList match(const PrototypeMap& map, Descriptors descriptors,
                              const MatchOptions& options = {});
PROTOMARK_API MatchList match(const SealedMap& map, Descriptors descriptors,
                              const MatchOptions& options = {});

// Returns the matches that are likely enough: landmark nearest[i], -1 for none, is right for
// keypoint i with probabilities[i]. A landmark keeps its likeliest keypoint, ties to the smaller
// row. Throws std::invalid_argument if sizes differ.
PROTOMARK_API MatchList accept(std::span<const int64_t> nearest,
                               std::span<const double> probabilities, double min_probability);

}  // namespace protomark
