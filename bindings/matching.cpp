// Match calibration and matches.
#include "protomark/matching.h"

#include <nanobind/stl/array.h>

#include "module.h"
#include "search.h"

namespace protomark::python {
namespace {

nb::object float64(nb::handle array) {
  return numpy("ascontiguousarray")(array, nb::arg("dtype") = numpy("float64"));
}

nb::object probability(const MatchCalibration& calibration, nb::handle distances) {
  const auto d = nb::cast<nb::ndarray<const double, nb::c_contig>>(float64(distances));
  if (d.ndim() != 2 || d.shape(1) < 2) {
    throw nb::value_error("distances: an (n, 2 or more) array is needed");
  }
  std::vector<double> result(d.shape(0));
  for (std::size_t i = 0; i < result.size(); ++i) {
    const double* row = d.data() + i * d.shape(1);
    result[i] = calibration.probability(row[0], row[1]);
  }
  return to_numpy(std::move(result));
}

nb::tuple arrays_of(MatchList matches) {
  const std::size_t n = matches.size();
  return nb::make_tuple(to_array<std::int64_t>(std::move(matches.keypoints), {n}),
                        to_numpy(std::move(matches.landmarks)),
                        to_numpy(std::move(matches.probabilities)));
}

template <typename Map>
void bind_match(nb::module_& m, const std::string& type) {
  const std::string signature =
      "def match(scene: " + type +
      ", descriptors: NDArray[numpy.uint8 | numpy.float32], min_probability: float, threads: int, "
      "recall: float | None, among: ArrayLike | None) -> "
      "tuple[NDArray[numpy.int64], NDArray[numpy.int64], NDArray[numpy.float64]]";
  m.def(
      "match",
      [](const Map& map, nb::object array, double min_probability, int threads,
         std::optional<double> recall, std::optional<nb::object> among) {
        const auto d = descriptors(array, *map.encoder());
        MatchOptions options{min_probability, recall, std::nullopt, threads};
        std::vector<std::int64_t> searched;
        if (among) {
          searched = ids_or_mask(map, *among);
          options.among = searched;
        }
        return arrays_of(without_gil([&] { return match(map, view(d), options); }));
      },
      "scene"_a, "descriptors"_a.none(), "min_probability"_a, "threads"_a, "recall"_a.none(),
      "among"_a.none(), nb::sig(signature.c_str()),
      "See protomark.matching.match: keypoints, landmarks and probabilities.");
}

}  // namespace

void bind_matching(nb::module_& m) {
  nb::class_<MatchCalibration>(m, "MatchCalibration",
                               R"(P(right) = 1 / (1 + exp(-(w0 + w1 d^2 + w2 (s^2 - d^2)))).

d and s are the distances to the nearest and to the second nearest landmark, in code units. Training
makes exp(-distance^2 / T) the likelihood of a landmark (Snell et al., Prototypical Networks, NeurIPS
2017), so the margin between two of them is a difference of squares; d itself says whether the
keypoint's landmark is in the map at all. Where there is no second landmark, s is taken for 2 d.)")
      .def(
          "__init__",
          [](MatchCalibration* self, std::array<double, 3> weights) {
            new (self) MatchCalibration{weights};
          },
          "weights"_a, nb::sig("def __init__(self, weights: Sequence[float]) -> None"),
          "Take the weights w0, w1, w2.")
      .def_static(
          "of",
          [](const Encoder& encoder, nb::object dim, bool tuned) {
            return MatchCalibration::of(encoder, code_length(dim), tuned);
          },
          "encoder"_a, "dim"_a.none() = nb::none(), "tuned"_a = false,
          nb::sig("def of(encoder: Encoder, dim: int | None = None, tuned: bool = False) -> "
                  "MatchCalibration"),
          "The calibration that an encoder's model file has for codes of `dim` numbers (None: "
          "all), and for mean or tuned prototypes. Raises ValueError if the encoder was never "
          "calibrated for these.")
      .def_prop_ro(
          "weights",
          [](const MatchCalibration& c) {
            return nb::make_tuple(c.weights[0], c.weights[1], c.weights[2]);
          },
          nb::sig("def weights(self) -> tuple[float, float, float]"), "w0, w1, w2.")
      .def("probability", &probability, "distances"_a,
           nb::sig("def probability(self, distances: ArrayLike) -> NDArray[numpy.float64]"),
           "Probabilities (n,) that the nearest landmarks are right, 0 where there is none, by "
           "squared distances (n, 2 or more), as `search` gives them.")
      .def(
          "__eq__",
          [](const MatchCalibration& a, nb::handle b) {
            return nb::isinstance<MatchCalibration>(b) && a == nb::cast<MatchCalibration>(b);
          },
          nb::sig("def __eq__(self, other: object, /) -> bool"))
      .def("__hash__",
           [](const MatchCalibration& c) {
             return nb::hash(nb::make_tuple(c.weights[0], c.weights[1], c.weights[2]));
           })
      .def("__repr__", [](const MatchCalibration& c) {
        return std::string("MatchCalibration(") +
               nb::repr(nb::make_tuple(c.weights[0], c.weights[1], c.weights[2])).c_str() + ")";
      });
  bind_match<PrototypeMap>(m, "PrototypeMap");
  bind_match<SealedMap>(m, "SealedMap");
  m.def(
      "accept",
      [](nb::object nearest, nb::object probabilities, double min_probability) {
        const auto ids = landmark_ids(nearest);
        const auto p = nb::cast<Array1<double>>(float64(probabilities));
        return arrays_of(accept(view(ids), view(p), min_probability));
      },
      "nearest"_a, "probabilities"_a, "min_probability"_a,
      nb::sig("def accept(nearest: NDArray[numpy.int64], probabilities: NDArray[numpy.float64], "
              "min_probability: float) -> "
              "tuple[NDArray[numpy.int64], NDArray[numpy.int64], NDArray[numpy.float64]]"),
      "See protomark.matching.accept: keypoints, landmarks and probabilities.");
}

}  // namespace protomark::python
