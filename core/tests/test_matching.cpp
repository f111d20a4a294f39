// Matches and their probabilities against their definitions.
#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>

#include "check.h"
#include "random.h"
#include "sealing.h"

using namespace protomark;
using protomark::test::Random;

namespace {

std::shared_ptr<const Encoder> with_note(const std::string& note) {
  const auto plain = test::random_encoder();
  EncoderInfo info = plain->info();
  info.notes = {{"other", "12 9 9 9"}, {"match_calibration", note}};
  return std::make_shared<const Encoder>(
      Encoder(std::move(info), plain->layers(), plain->dims(), plain->scale(), plain->codebooks()));
}

void test_notes() {
  const auto encoder = with_note("6 1 -2.5 3e-7\n12 0.5 1 -12345.6");
  CHECK(MatchCalibration::of(*encoder, 6) == MatchCalibration{{1, -2.5, 3e-7}});
  CHECK(MatchCalibration::of(*encoder, 12) == MatchCalibration{{0.5, 1, -12345.6}});
  CHECK(MatchCalibration::of(*encoder) == MatchCalibration::of(*encoder, 12));
  const auto none = [](const Encoder& e, std::size_t dim) {
    return check::throws<std::invalid_argument>([&] { MatchCalibration::of(e, dim); },
                                                "protomark calibrate");
  };
  // In between, weights are interpolated.
  const MatchCalibration half = MatchCalibration::of(*encoder, 9);
  CHECK(half.weights[0] == 0.75 && half.weights[1] == -0.75);
  CHECK(none(*encoder, 5) && none(*encoder, 13));
  CHECK(none(*test::random_encoder(), 12));
  CHECK(none(*with_note(""), 12));
  for (const char* note :
       {"12 1 2", "12 1 2 3 4", "12 1 2 nan", "12 1 2 inf", "12 1 2 1e999", "12 1 2 x", "\n",
        "12 1 2 3\n\n6 1 2 3", "6 1 2\n12 1 2 3", "12 1 2 3\n6"}) {
    const auto broken = with_note(note);
    CHECK(check::throws<std::invalid_argument>([&] { MatchCalibration::of(*broken, 12); },
                                               "note on match_calibration is broken"));
  }
}

void test_probability() {
  const MatchCalibration c{{1, -0.05, 0.02}};
  const auto sigmoid = [](double x) { return 1 / (1 + std::exp(-x)); };
  CHECK(std::abs(c.probability(16, 64) - sigmoid(1 - 0.8 + 0.96)) < 1e-15);
  CHECK(c.probability(16, INT32_MAX) == c.probability(16, 64));
  CHECK(c.probability(0, 0) == sigmoid(1));
  CHECK(c.probability(INT32_MAX, INT32_MAX) == 0);
  // Nothing overflows.
  const MatchCalibration steep{{0, 0, 1}};
  CHECK(steep.probability(0, INT32_MAX - 1) == 1);
  CHECK(steep.probability(INT32_MAX - 1, 0) == 0);
  CHECK(steep.probability(INT32_MAX - 1, INT32_MAX) == 1);
}

// The definition: of all matches that are likely enough, the likeliest whose landmark is free is
// next, ties to the smaller row.
MatchList by_definition(std::span<const std::int64_t> nearest, std::span<const double> p,
                        double least) {
  MatchList result;
  for (;;) {
    std::optional<std::size_t> best;
    for (std::size_t i = 0; i < nearest.size(); ++i) {
      const bool matched =
          std::ranges::find(result.landmarks, nearest[i]) != result.landmarks.end();
      if (nearest[i] < 0 || matched || !(p[i] >= least)) continue;
      if (!best || p[i] > p[*best]) best = i;
    }
    if (!best) return result;
    result.keypoints.push_back(*best);
    result.landmarks.push_back(nearest[*best]);
    result.probabilities.push_back(p[*best]);
  }
}

void test_accepting() {
  Random random(1);
  for (int round = 0; round < 200; ++round) {
    const auto n = static_cast<std::size_t>(random.integer(0, 40));
    const auto nearest = random.integers<std::int64_t>(n, -1, 12);
    std::vector<double> p;
    for (std::size_t i = 0; i < n; ++i) {
      p.push_back(static_cast<double>(random.integer(0, 10)) / 10);
      if (random.integer(0, 20) == 0) p.back() = std::numeric_limits<double>::quiet_NaN();
    }
    for (const double least : {0.0, 0.3, 1.0}) {
      CHECK(accept(nearest, p, least) == by_definition(nearest, p, least));
    }
  }
  CHECK(check::throws<std::invalid_argument>(
      [] { accept(std::vector<std::int64_t>{1, 2}, std::vector<double>{0.5}, 0.2); },
      "1 probabilities do not fit 2 landmarks"));
}

template <typename Map>
void check_matching(const Map& map, Descriptors queries, const MatchOptions& options) {
  const auto calibration = MatchCalibration::of(*map.encoder(), map.dim());
  const auto [ids, distances] = map.search(queries, 2, {.among = options.among});
  std::vector<std::int64_t> nearest;
  std::vector<double> p;
  for (std::size_t i = 0; i < queries.rows; ++i) {
    nearest.push_back(ids.row(i)[0]);
    p.push_back(calibration.probability(distances.row(i)[0], distances.row(i)[1]));
  }
  const MatchList found = match(map, queries, options);
  CHECK(found == by_definition(nearest, p, options.min_probability));
  if (!options.among && options.min_probability < 0.5) CHECK(found.size() > 50);
}

void test_matching() {
  const auto encoder = with_note("12 0 -1e-5 1e-4");
  Random random(2);
  PrototypeMap map(encoder, 12, 4);
  const std::size_t n = 600;
  const auto ids = random.integers<std::int64_t>(n, 0, 1'000'000'000'000);
  const auto bytes = random.integers<std::uint8_t>(n * encoder->bytes(), 0, 255);
  for (int view = 0; view < 3; ++view) {
    auto seen = bytes;
    for (auto& byte : seen) byte ^= static_cast<std::uint8_t>(random.integer(0, 9) == 0);
    map.add(ids, {seen.data(), n, encoder->bytes()});
  }
  // Each is asked twice, so that keypoints compete for landmarks.
  auto asked = bytes;
  asked.insert(asked.end(), bytes.begin(), bytes.end());
  for (auto& byte : asked) byte ^= static_cast<std::uint8_t>(random.integer(0, 2) == 0);
  const Descriptors queries{asked.data(), 2 * n, encoder->bytes()};
  const std::vector<std::int64_t> some(ids.begin(), ids.begin() + 50);

  const auto path = std::filesystem::temp_directory_path() / "protomark_matching.pmk";
  const auto check_both = [&] {
    map.seal(path, test::in_words(map, 1.5));
    const SealedMap sealed(path);
    const auto each = [&](const MatchOptions& options) {
      check_matching(map, queries, options);
      check_matching(sealed, queries, options);
    };
    each({});
    each({.min_probability = 0.6});
    each({.min_probability = 1.0});
    each({.among = some, .threads = 2});
    each({.among = std::span<const std::int64_t>()});
    if (map.nlist() > 0) each({.recall = 1.0, .threads = 3});
    for (const Descriptors none : {Descriptors{}, Descriptors{asked.data(), 0, encoder->bytes()}}) {
      CHECK(match(map, none) == MatchList{});
      CHECK(match(sealed, none) == MatchList{});
    }
    std::filesystem::remove(path);
  };
  check_both();
  map.build_index({.nlist = 8});
  check_both();

  for (const double wrong : {-0.1, 1.1, std::numeric_limits<double>::quiet_NaN()}) {
    CHECK(check::throws<std::invalid_argument>(
        [&] { match(map, queries, {.min_probability = wrong}); }, "min_probability"));
  }
  const std::vector<std::int64_t> unknown = {-5};
  CHECK(check::throws<UnknownLandmark>([&] { match(map, queries, {.among = unknown}); }));
  CHECK(check::throws<std::invalid_argument>(
      [&] { match(map, {asked.data(), 1, encoder->bytes() - 1}); }, "bytes"));
  CHECK(check::throws<std::invalid_argument>(
      [&] { match(PrototypeMap(test::random_encoder()), queries); }, "protomark calibrate"));
}

}  // namespace

int main() {
  test_notes();
  test_probability();
  test_accepting();
  test_matching();
  return check::result();
}
