#include "protomark/matching.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <locale>
#include <map>
#include <unordered_set>

#include "base/text.h"

namespace protomark {
namespace {

// A note has a line for each length of codes: the length and three weights.
constexpr char kNote[] = "match_calibration", kTunedNote[] = "match_calibration_tuned";

// Between lengths that a note has, weights are interpolated.
std::optional<MatchCalibration> read_note(const std::string& note, size_t dim) {
  std::map<size_t, MatchCalibration> fitted;
  std::istringstream lines(note);
  for (std::string line; std::getline(lines, line);) {
    std::istringstream in(line);
    in.imbue(std::locale::classic());
    size_t length = 0;
    MatchCalibration calibration;
    in >> length;
    for (double& weight : calibration.weights) in >> weight;
    std::string rest;
    require(!in.fail() && !(in >> rest), "the model's note on ", kNote, " is broken: '",
            line.substr(0, 80), "'");
    fitted.emplace(length, calibration);
  }
  const auto next = fitted.lower_bound(dim);
  if (next == fitted.end() || (next == fitted.begin() && next->first != dim)) return std::nullopt;
  MatchCalibration found = next->second;
  if (next->first == dim) return found;
  const auto& [shorter, before] = *std::prev(next);
  const double share =
      static_cast<double>(dim - shorter) / static_cast<double>(next->first - shorter);
  for (size_t i = 0; i < found.weights.size(); ++i) {
    found.weights[i] = std::lerp(before.weights[i], found.weights[i], share);
  }
  return found;
}

MatchList match_with(const auto& map, bool tuned, Descriptors descriptors,
                     const MatchOptions& options) {
  require(options.min_probability >= 0 && options.min_probability <= 1,
          "min_probability must be 0 to 1, not ", options.min_probability);
  const auto calibration = MatchCalibration::of(*map.encoder(), map.dim(), tuned);
  const auto [ids, distances] =
      map.search(descriptors, 2,
                 {.recall = options.recall, .among = options.among, .threads = options.threads});
  std::vector<int64_t> nearest(ids.rows);
  std::vector<double> probabilities(ids.rows);
  for (size_t i = 0; i < ids.rows; ++i) {
    nearest[i] = ids.row(i)[0];
    probabilities[i] = calibration.probability(distances.row(i)[0], distances.row(i)[1]);
  }
  return accept(nearest, probabilities, options.min_probability);
}

}  // namespace

MatchCalibration MatchCalibration::of(const Encoder& encoder, size_t dim, bool tuned) {
  if (dim == 0) dim = encoder.dim();
  for (const auto& [key, note] : encoder.info().notes) {
    if (key != (tuned ? kTunedNote : kNote)) continue;
    if (const auto found = read_note(note, dim)) return *found;
  }
  invalid("encoder '", encoder.info().name, "' has no match calibration for ",
          tuned ? "tuned prototypes" : "codes", " of ", dim,
          " numbers: run `protomark calibrate MODEL TRACKS...` and build the map with that model");
}

double MatchCalibration::probability(double nearest, double second) const {
  if (nearest >= INT32_MAX) return 0;
  const double margin = (second < INT32_MAX ? second : 4 * nearest) - nearest;
  const double x = weights[0] + weights[1] * nearest + weights[2] * margin;
  const double e = std::exp(-std::abs(x));  // at most 1, so that nothing overflows
  return (x >= 0 ? 1 : e) / (1 + e);
}

MatchList accept(std::span<const int64_t> nearest, std::span<const double> probabilities,
                 double min_probability) {
  require(nearest.size() == probabilities.size(), probabilities.size(),
          " probabilities do not fit ", nearest.size(), " landmarks");
  std::vector<size_t> order;
  for (size_t i = 0; i < nearest.size(); ++i) {
    if (nearest[i] >= 0 && probabilities[i] >= min_probability) order.push_back(i);
  }
  std::ranges::stable_sort(order, std::greater(), [&](size_t i) { return probabilities[i]; });
  MatchList result;
  std::unordered_set<int64_t> matched;
  for (const size_t i : order) {
    if (!matched.insert(nearest[i]).second) continue;
    result.keypoints.push_back(i);
    result.landmarks.push_back(nearest[i]);
    result.probabilities.push_back(probabilities[i]);
  }
  return result;
}

MatchList match(const PrototypeMap& map, Descriptors descriptors, const MatchOptions& options) {
  return match_with(map, false, descriptors, options);
}
MatchList match(const SealedMap& map, Descriptors descriptors, const MatchOptions& options) {
  return match_with(map, map.tuned(), descriptors, options);
}

}  // namespace protomark
