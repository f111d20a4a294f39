// Binds what learning and sealed maps have in common.
#pragma once

#include <algorithm>
#include <optional>
#include <string>

#include "module.h"
#include "protomark/encoder.h"
#include "protomark/search.h"

namespace protomark::python {

nb::dict from_summary(const MapSummary& summary, bool counted);

// The ids of some landmarks, given as such or as a mask over all ids in ascending order.
template <typename Map>
std::vector<std::int64_t> ids_or_mask(const Map& map, nb::handle among) {
  const nb::object array = numpy("asarray")(among);
  if (nb::cast<std::string>(array.attr("dtype").attr("kind")) != "b") {
    const auto ids = landmark_ids(array);
    return {ids.data(), ids.data() + ids.size()};
  }
  const auto mask = nb::cast<Array1<bool>>(numpy("ascontiguousarray")(array));
  const std::vector<std::int64_t> ids = without_gil([&] { return map.ids(); });
  if (mask.size() != ids.size()) {
    throw std::invalid_argument("among: a mask of " + std::to_string(mask.size()) +
                                " landmarks does not fit a map of " + std::to_string(ids.size()));
  }
  std::vector<std::int64_t> result;
  for (std::size_t i = 0; i < ids.size(); ++i) {
    if (mask.data()[i]) result.push_back(ids[i]);
  }
  return result;
}

// Binds Map::search or Map::search_codes, whose queries are to_queries(map, array).
template <typename Map, typename ToQueries, typename Search>
auto bind_search(ToQueries to_queries, Search search) {
  return
      [=](const Map& map, nb::object queries, nb::object k, std::optional<nb::object> max_distance,
          std::optional<double> ratio, nb::object threads, std::optional<double> recall,
          std::optional<nb::object> nprobe, std::optional<nb::object> among) {
        const auto q = to_queries(map, queries);
        const auto count = integer<std::size_t>(k, "k");
        SearchOptions options;
        options.recall = recall;
        options.ratio = ratio;
        options.threads = integer<int>(threads, "threads");
        if (nprobe) options.nprobe = integer<std::size_t>(*nprobe, "nprobe");
        std::vector<std::int64_t> searched;
        if (among) {
          searched = ids_or_mask(map, *among);
          options.among = searched;
        }
        if (max_distance) {
          options.max_distance = integer<std::int32_t>(*max_distance, "max_distance");
        }
        return to_numpy(without_gil([&] { return (map.*search)(view(q), count, options); }));
      };
}

// Bind a method that takes ids of landmarks, or one id.
template <typename Map, typename Of>
auto bind_of_landmarks(Of of) {
  return [of](const Map& map, nb::object ids) {
    const auto l = landmark_ids(ids);
    return to_numpy(without_gil([&] { return (map.*of)(view(l)); }));
  };
}
template <typename Map, typename Of>
auto bind_of_landmark(Of of) {
  return [of](const Map& map, nb::object id) {
    const auto ids = landmark_ids(id);
    if (ids.size() != 1) type_error("one landmark id is needed, not " + std::to_string(ids.size()));
    return to_numpy(without_gil([&] { return (map.*of)(ids(0)); }));
  };
}

// As in "2 landmarks, 3 prototypes, 48 dimensions, encoder 'freak'".
template <typename Map>
std::string describe_map(const Map& map) {
  const auto [landmarks, prototypes] =
      without_gil([&] { return std::pair(map.size(), map.prototype_count()); });
  return std::to_string(landmarks) + " landmarks" +
         (prototypes == landmarks ? "" : ", " + std::to_string(prototypes) + " prototypes") + ", " +
         std::to_string(map.dim()) + " dimensions, encoder '" + map.encoder()->info().name + "'";
}

template <typename Map>
void bind_answers(nb::class_<Map>& map) {
  const auto to_descriptors = [](const Map& m, nb::handle q) {
    return descriptors(q, *m.encoder());
  };
  const auto to_codes = [](const Map&, nb::handle q) { return codes(q); };
  map.def("__len__", &Map::size, ReleaseGil())
      .def_prop_ro("encoder", &Map::encoder, "The encoder of this map.")
      .def_prop_ro("dim", &Map::dim, "Dimensions of a prototype.")
      .def_prop_ro("prototype_count", &Map::prototype_count, ReleaseGil(),
                   "Number of prototypes: one per landmark, or one per appearance.")
      .def_prop_ro("nlist", &Map::nlist, ReleaseGil(),
                   "Number of inverted lists; 0 means that there is no index.")
      .def_prop_ro(
          "ids", [](const Map& m) { return to_numpy(without_gil([&] { return m.ids(); })); },
          nb::sig("def ids(self) -> NDArray[numpy.int64]"),
          "The ids of all landmarks in ascending order, (n,) int64.")
      .def("prototypes", bind_of_landmarks<Map>(&Map::prototypes), "landmark_ids"_a,
           nb::sig("def prototypes(self, landmark_ids: ArrayLike) -> NDArray[numpy.float32]"),
           "Mean codes (Komorowski and Trzcinski, Eq. 1), (n, dim) float32, in code units, over "
           "all appearances. A sealed map gives them rounded, or the nearest words, and the plain "
           "mean of several. Raises KeyError for an id that is not in the map.")
      .def("positions", bind_of_landmarks<Map>(&Map::positions), "landmark_ids"_a,
           nb::sig("def positions(self, landmark_ids: ArrayLike) -> NDArray[numpy.float64]"),
           "World coordinates, (n, 3) float64, NaN where a landmark has none. Raises KeyError for "
           "an id that is not in the map.")
      .def(
          "appearances", bind_of_landmark<Map>(&Map::appearances), "landmark_id"_a,
          nb::sig("def appearances(self, landmark_id: int) -> NDArray[numpy.float32]"),
          "The prototypes of one landmark, one per appearance, (r, dim) float32, in code units; in "
          "a sealed map with an index they come in no particular order. Raises KeyError for an id "
          "that is not in the map.")
      .def(
          "summary",
          [](const Map& m) {
            constexpr bool counted = requires { m.appearance_bits(); };  // a learning map
            return from_summary(without_gil([&] { return m.summary(); }), counted);
          },
          nb::sig("def summary(self) -> dict[str, Any]"),
          R"(The map at a glance, in one pass that keeps nothing in memory.

Returns:
    observations: their number; only of a learning map.
    count_histogram: (256,) int64, how many landmarks have i observations at index i, and that many
        or more at the last index; only of a learning map.
    landmarks_with_position: their number.
    extent: (2, 3) float64, the lowest and highest coordinates; None if no landmark has a position.)")
      .def(
          "search", bind_search<Map>(to_descriptors, &Map::search), "descriptors"_a.none(),
          "k"_a.none() = 2, "max_distance"_a = nb::none(), "ratio"_a = nb::none(),
          "threads"_a.none() = 1, "recall"_a = nb::none(), "nprobe"_a = nb::none(),
          "among"_a = nb::none(),
          nb::sig("def search(self, descriptors: NDArray[numpy.uint8 | numpy.float32], k: int = 2, "
                  "max_distance: int | None = None, ratio: float | None = None, "
                  "threads: int = 1, recall: float | None = None, nprobe: int | None = None, "
                  "among: ArrayLike | None = None) -> "
                  "tuple[NDArray[numpy.int64], NDArray[numpy.int32]]"),
          R"(Find the k nearest landmarks of each descriptor; ties go to the smaller id.

Args:
    descriptors: (q, ...), as Encoder.encode takes them.
    k: neighbours to return.
    max_distance: the largest squared distance at which a neighbour is reported.
    ratio: Lowe's ratio test, in (0, 1]: a query keeps its neighbours only if the nearest landmark
        is nearer than ratio times the second nearest, by root distances: squared distances must
        fulfil nearest < ratio * ratio * second.
    threads: threads to use.
    recall: in (0, 1]: an approximate search in a map with an index that finds the nearest landmark
        of this share of the queries, as measured on the map (nprobe()). None: an exact search.
    nprobe: instead of recall, the number of inverted lists to search.
    among: the landmarks to search: ids (n,), or a mask (landmarks,) bool in the order of `ids`.
        Neighbours are those that a map of these landmarks alone would give, at a cost that follows
        their number. None: all.

Returns:
    ids (q, k) int64, nearest first, -1 where there is none, and squared Euclidean distances
    (q, k) int32, in code units, 2^31 - 1 where there is none.

Raises:
    TypeError: descriptors are of another type than the encoder's.
    KeyError: `among` has an id that is not in the map.
    ValueError: the encoder refuses the descriptors; k, threads or nprobe is below 1;
        a mask is of another length than the map;
        max_distance is negative; ratio or recall is out of its range; recall and nprobe are both
        given, or one of them and the map has no index (PrototypeMap.build_index).)")
      .def("search_codes", bind_search<Map>(to_codes, &Map::search_codes), "codes"_a.none(),
           "k"_a.none() = 2, "max_distance"_a = nb::none(), "ratio"_a = nb::none(),
           "threads"_a.none() = 1, "recall"_a = nb::none(), "nprobe"_a = nb::none(),
           "among"_a = nb::none(),
           nb::sig("def search_codes(self, codes: NDArray[numpy.int8], k: int = 2, "
                   "max_distance: int | None = None, ratio: float | None = None, "
                   "threads: int = 1, recall: float | None = None, nprobe: int | None = None, "
                   "among: ArrayLike | None = None) -> "
                   "tuple[NDArray[numpy.int64], NDArray[numpy.int32]]"),
           "Like search, for descriptors that are encoded already: (q, dim) int8. Raises "
           "ValueError if they have another length.");
}

}  // namespace protomark::python
