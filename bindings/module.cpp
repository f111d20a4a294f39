// The Python module protomark._core: arrays in, arrays out, the GIL released while C++ works.
#include <nanobind/nanobind.h>
#include <nanobind/stl/filesystem.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <stdexcept>

#include "arrays.h"
#include "protomark/encoder.h"
#include "protomark/error.h"
#include "protomark/hamming.h"
#include "protomark/instruction_set.h"
#include "protomark/map_file.h"
#include "protomark/prototypes.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace protomark::python {
namespace {

using Path = std::filesystem::path;
// For whatever may wait for another thread, or for a disk: others run Python meanwhile.
using ReleaseGil = nb::call_guard<nb::gil_scoped_release>;

// What `work` returns, the GIL released while it runs.
template <typename Work>
auto without_gil(const Work& work) {
  const nb::gil_scoped_release release;
  return work();
}

SearchOptions search_options(std::optional<std::int64_t> max_distance, std::optional<double> ratio,
                             int threads, std::optional<double> recall,
                             std::optional<std::size_t> probes) {
  SearchOptions options;
  if (max_distance) {
    options.max_distance =
        static_cast<std::int32_t>(std::clamp<std::int64_t>(*max_distance, -1, INT32_MAX));
  }
  options.ratio = ratio;
  options.threads = threads;
  options.recall = recall;
  options.nprobe = probes;
  return options;
}

nb::tuple hamming(nb::object queries, nb::object database, std::size_t k,
                  std::optional<nb::object> landmark_ids, std::optional<int> max_distance,
                  int threads) {
  const auto q = descriptors(queries);
  const auto d = descriptors(database);
  NewMatrix<std::int64_t> ids(q.shape(0), k);
  NewMatrix<std::int32_t> distances(q.shape(0), k);
  HammingOptions options;
  options.max_distance = max_distance;
  options.threads = threads;
  if (landmark_ids) {
    const auto l = landmarks(*landmark_ids);
    const nb::gil_scoped_release release;
    hamming_search(view(q), view(d), view(l), options, ids.view(), distances.view());
  } else {
    const nb::gil_scoped_release release;
    hamming_search(view(q), view(d), options, ids.view(), distances.view());
  }
  return nb::make_tuple(ids.release(), distances.release());
}

// Makes room for the answer and lets `run` fill it without the GIL.
template <typename Run>
nb::tuple answer(std::size_t queries, std::size_t k, const Run& run) {
  NewMatrix<std::int64_t> ids(queries, k);
  NewMatrix<std::int32_t> distances(queries, k);
  {
    const nb::gil_scoped_release release;
    run(ids.view(), distances.view());
  }
  return nb::make_tuple(ids.release(), distances.release());
}

// Open and sealed maps search alike.
template <typename Map>
nb::tuple search(const Map& map, nb::object queries, std::size_t k,
                 std::optional<std::int64_t> max_distance, std::optional<double> ratio, int threads,
                 std::optional<double> recall, std::optional<std::size_t> probes) {
  const auto q = descriptors(queries);
  const SearchOptions options = search_options(max_distance, ratio, threads, recall, probes);
  return answer(q.shape(0), k,
                [&](MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
                  map.search(view(q), options, ids, distances);
                });
}

template <typename Map>
nb::tuple search_codes(const Map& map, nb::object queries, std::size_t k,
                       std::optional<std::int64_t> max_distance, std::optional<double> ratio,
                       int threads, std::optional<double> recall,
                       std::optional<std::size_t> probes) {
  const auto q = codes(queries);
  const SearchOptions options = search_options(max_distance, ratio, threads, recall, probes);
  return answer(q.shape(0), k,
                [&](MatrixView<std::int64_t> ids, MatrixView<std::int32_t> distances) {
                  map.search_codes(view(q), options, ids, distances);
                });
}

template <typename Map>
nb::object prototype(const Map& map, nb::object landmark_ids) {
  const auto l = landmarks(landmark_ids);
  NewMatrix<float> means(l.shape(0), map.dim());
  without_gil([&] { map.prototypes(view(l), means.view()); });
  return means.release();
}

// Counts in as small a type as they fit.
nb::object counts(const std::vector<std::uint32_t>& values, bool one_byte) {
  if (!one_byte) return new_vector(values);
  return new_vector(std::vector<std::uint8_t>(values.begin(), values.end()));
}

// Vectors of one length as the rows of an array.
nb::object stacked(const std::vector<std::vector<float>>& rows, std::size_t columns) {
  NewMatrix<float> result(rows.size(), columns);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    std::copy(rows[i].begin(), rows[i].end(), result.view().row(i));
  }
  return result.release();
}

// "2 landmarks", and ", 3 prototypes" where there are more.
template <typename Map>
std::string describe_size(const Map& map) {
  const nb::gil_scoped_release release;
  const std::size_t landmarks = map.size(), prototypes = map.prototype_count();
  return std::to_string(landmarks) + " landmarks" +
         (prototypes == landmarks ? "" : ", " + std::to_string(prototypes) + " prototypes");
}

nb::object from_metadata(const Metadata& metadata) {
  nb::dict texts;
  for (const auto& [name, text] : metadata) texts[nb::str(name.c_str(), name.size())] = text;
  return nb::module_::import_("types").attr("MappingProxyType")(texts);
}

Metadata to_metadata(nb::handle object) {
  // Raises UnicodeEncodeError for surrogates, which are no UTF-8.
  const auto utf8 = [](nb::handle text) {
    const auto bytes = nb::cast<nb::bytes>(text.attr("encode")());
    return std::string(bytes.c_str(), bytes.size());
  };
  Metadata result;
  const nb::object texts = nb::module_::import_("builtins").attr("dict")(object);
  for (const auto& [name, text] : nb::cast<nb::dict>(texts)) {
    if (!nb::isinstance<nb::str>(name) || !nb::isinstance<nb::str>(text)) {
      throw nb::type_error(("metadata: names and texts must be str, not " +
                            std::string(nb::repr(name).c_str()) + ": " + nb::repr(text).c_str())
                               .c_str());
    }
    result.emplace(utf8(name), utf8(text));
  }
  return result;
}

nb::dict from_summary(const MapSummary& summary) {
  nb::dict result;
  result["observations"] = summary.observations;
  const auto& counts = summary.landmarks_by_count;
  result["count_histogram"] = new_vector(std::vector<std::int64_t>(counts.begin(), counts.end()));
  result["landmarks_with_position"] = summary.placed;
  if (summary.placed != 0) {
    result["extent"] = from_positions({summary.low, summary.high});
  } else {
    result["extent"] = nb::none();
  }
  return result;
}

// What open and sealed maps have in common.
template <typename Map>
void bind_reading(nb::class_<Map>& map) {
  map.def("__len__", &Map::size, ReleaseGil())
      .def_prop_ro("encoder", &Map::encoder, "The encoder of this map.")
      .def_prop_ro("dim", &Map::dim, "Dimensions of a prototype.")
      .def_prop_ro("prototype_count", &Map::prototype_count, ReleaseGil(),
                   "Number of prototypes: one a landmark, or one for each of its looks.")
      .def_prop_ro("index_cells", &Map::index_cells, ReleaseGil(),
                   "Number of cells of the index; 0: there is none.")
      .def_prop_ro(
          "ids", [](const Map& m) { return new_vector(without_gil([&] { return m.ids(); })); },
          nb::sig("def ids(self) -> NDArray[numpy.int64]"),
          "All landmark ids, ascending, (n,) int64.")
      .def(
          "prototype", &prototype<Map>, "landmark_ids"_a,
          nb::sig("def prototype(self, landmark_ids: ArrayLike) -> NDArray[numpy.float32]"),
          "Mean codes (Komorowski and Trzcinski, Eq. 1), (n, dim) float32, in code units, over all "
          "looks; a sealed map gives them rounded, to one of 16 levels where its code_bits is 4, "
          "and of a landmark with several looks their plain mean. Raises KeyError for an id that "
          "is not in the map.")
      .def(
          "positions",
          [](const Map& m, nb::object ids) {
            const auto l = landmarks(ids);
            return from_positions(without_gil([&] { return m.positions(view(l)); }));
          },
          "landmark_ids"_a,
          nb::sig("def positions(self, landmark_ids: ArrayLike) -> NDArray[numpy.float64]"),
          "World coordinates, (n, 3) float64, NaN where there are none. Raises KeyError for an id "
          "that is not in the map.")
      .def(
          "summary",
          [](const Map& m) {
            MapSummary summary;
            {
              const nb::gil_scoped_release release;
              summary = m.summary();
            }
            return from_summary(summary);
          },
          nb::sig("def summary(self) -> dict[str, Any]"),
          R"(The map at a glance, in one pass that keeps nothing in memory.

Returns:
    observations: their number, in a sealed map at most 255 of a landmark.
    count_histogram: (256,) int64, landmarks with so many observations, the last one: or more.
    landmarks_with_position: their number.
    extent: (2, 3) float64, the lowest and highest coordinates; None where no landmark has any.)")
      .def("search", &search<Map>, "descriptors"_a, "k"_a = 2, "max_distance"_a = nb::none(),
           "ratio"_a = nb::none(), "threads"_a = 1, "recall"_a = nb::none(),
           "probes"_a = nb::none(),
           nb::sig("def search(self, descriptors: NDArray[numpy.uint8], k: int = 2, "
                   "max_distance: int | None = None, ratio: float | None = None, "
                   "threads: int = 1, recall: float | None = None, probes: int | None = None) -> "
                   "tuple[NDArray[numpy.int64], NDArray[numpy.int32]]"),
           R"(The k nearest landmarks of each descriptor; ties go to the smaller id.

Args:
    descriptors: (q, bits / 8) uint8.
    k: neighbours to return.
    max_distance: the largest squared distance at which a neighbour is reported.
    ratio: Lowe's ratio test, in (0, 1]: a query keeps its neighbours only where the nearest
        landmark is nearer than ratio times the second nearest, by root distances: squared
        distances must fulfil nearest < ratio * ratio * second.
    threads: threads to use.
    recall: in (0, 1]: an approximate search in a map with an index that finds the nearest landmark
        of this share of the queries, as measured on the map (probes()). None: an exact search.
    probes: instead of recall, the number of cells to search.

Returns:
    ids (q, k) int64, nearest first, -1 where there is none, and squared Euclidean distances
    (q, k) int32, in code units, 2^31 - 1 where there is none.

Raises:
    TypeError: descriptors are not (q, bits / 8) uint8.
    ValueError: descriptors are of another size than the encoder's; k, threads or probes is below 1;
        max_distance is negative; ratio or recall is out of its range; recall and probes are both
        given, or one of them where the map has no index (PrototypeMap.build_index).)")
      .def("search_codes", &search_codes<Map>, "codes"_a, "k"_a = 2, "max_distance"_a = nb::none(),
           "ratio"_a = nb::none(), "threads"_a = 1, "recall"_a = nb::none(),
           "probes"_a = nb::none(),
           nb::sig("def search_codes(self, codes: NDArray[numpy.int8], k: int = 2, "
                   "max_distance: int | None = None, ratio: float | None = None, "
                   "threads: int = 1, recall: float | None = None, probes: int | None = None) -> "
                   "tuple[NDArray[numpy.int64], NDArray[numpy.int32]]"),
           "Like search, for descriptors that are encoded already: (q, dim) int8. ValueError where "
           "they have another length.");
}

Layer to_layer(nb::dict d) {
  const auto vector = [&](const char* key, const char* type) {
    return numpy("ascontiguousarray")(d[key], "dtype"_a = numpy(type));
  };
  Layer layer;
  const auto weights = nb::cast<Matrix<std::int8_t>>(vector("weights", "int8"));
  const auto bias = nb::cast<Vector<std::int32_t>>(vector("bias", "int32"));
  const auto mult = nb::cast<Vector<std::int32_t>>(vector("mult", "int32"));
  layer.outputs = weights.shape(0);
  layer.inputs = weights.shape(1);
  layer.weights.assign(weights.data(), weights.data() + weights.size());
  layer.bias.assign(bias.data(), bias.data() + bias.size());
  layer.multipliers.assign(mult.data(), mult.data() + mult.size());
  layer.shift = nb::cast<int>(d["shift"]);
  if (!d["table"].is_none()) {
    const auto table = nb::cast<Vector<std::uint8_t>>(vector("table", "uint8"));
    if (table.size() != layer.table.size()) {
      throw nb::value_error("a layer's table must have 256 entries");
    }
    std::copy_n(table.data(), table.size(), layer.table.begin());
  }
  return layer;
}

nb::dict from_layer(const Layer& layer, bool hidden) {
  NewMatrix<std::int8_t> weights(layer.outputs, layer.inputs);
  std::copy(layer.weights.begin(), layer.weights.end(), weights.view().data);
  nb::dict d;
  d["weights"] = weights.release();
  d["bias"] = new_vector(layer.bias);
  d["mult"] = new_vector(layer.multipliers);
  d["shift"] = layer.shift;
  if (hidden) {
    d["table"] = new_vector(std::vector<std::uint8_t>(layer.table.begin(), layer.table.end()));
  } else {
    d["table"] = nb::none();
  }
  return d;
}

void bind_encoder(nb::module_& m) {
  nb::class_<Encoder>(m, "Encoder",
                      "A network from packed bits to int8 codes that gives the same bytes on every "
                      "machine.")
      .def(
          "__init__",
          [](Encoder* self, nb::list layers, std::vector<std::size_t> dims, std::string name,
             std::string descriptor, float scale, std::string data, std::string licence,
             std::map<std::string, std::string> notes) {
            std::vector<Layer> built;
            for (nb::handle layer : layers) built.push_back(to_layer(nb::cast<nb::dict>(layer)));
            EncoderInfo info{std::move(name),
                             std::move(descriptor),
                             std::move(data),
                             std::move(licence),
                             {notes.begin(), notes.end()}};
            const nb::gil_scoped_release release;
            new (self) Encoder(std::move(info), std::move(built), std::move(dims), scale);
          },
          "layers"_a, "dims"_a, "name"_a, "descriptor"_a, "scale"_a, "data"_a = "",
          "licence"_a = "", "notes"_a = nb::dict(),
          nb::sig(
              "def __init__(self, layers: list[dict[str, Any]], dims: Sequence[int], name: str, "
              "descriptor: str, scale: float, data: str = '', licence: str = '', "
              "notes: dict[str, str] = {}) -> None"),
          R"(An encoder from integer layers.

Args:
    layers: each a dict of weights (out, in) int8, bias (out,) int32, mult (out,) int32, shift, and
        table (256,) uint8, None in the last layer; docs/format.md says what is computed.
    dims: lengths at which a code may be cut, ascending, the last one its full length.
    name, descriptor, data, licence, notes: what the model says of itself.
    scale: real value of one code unit.

Raises:
    ValueError: layers do not fit together.)")
      .def_static(
          "load",
          [](nb::object source) {
            const nb::object path =
                nb::module_::import_("protomark.models").attr("resolve")(source);
            const auto file = nb::cast<Path>(path);
            return without_gil([&] { return Encoder::load(file); });
          },
          "source"_a, nb::sig("def load(source: str | os.PathLike[str]) -> Encoder"),
          R"(Load an encoder by the name of one that ships ("freak", "orb") or the path of a model file.

Raises:
    FileNotFoundError: there is no such model.
    FileError: the file is not a model.)")
      .def("save", &Encoder::save, "path"_a, ReleaseGil(),
           nb::sig("def save(self, path: str | os.PathLike[str]) -> None"),
           "Write the model file, whole or not at all. Raises FileError.")
      .def(
          "encode",
          [](const Encoder& encoder, nb::object array, std::optional<std::size_t> dim,
             int threads) {
            const auto d = descriptors(array);
            NewMatrix<std::int8_t> result(d.shape(0), dim.value_or(encoder.dim()));
            {
              const nb::gil_scoped_release release;
              encoder.encode(view(d), result.view(), threads);
            }
            return result.release();
          },
          "descriptors"_a, "dim"_a = nb::none(), "threads"_a = 1,
          nb::sig("def encode(self, descriptors: NDArray[numpy.uint8], dim: int | None = None, "
                  "threads: int = 1) -> NDArray[numpy.int8]"),
          R"(Codes of descriptors.

Args:
    descriptors: (n, bits / 8) uint8, the bytes that OpenCV gives.
    dim: length of a code, one of `dims`; None: the full length.
    threads: threads to use.

Returns:
    (n, dim) int8, -127 to 127.

Raises:
    TypeError: descriptors are not (n, bits / 8) uint8.
    ValueError: they are of another size than the encoder's, dim is none of `dims`, or threads is
        below 1.)")
      .def_prop_ro("bits", &Encoder::bits, "Bits of a descriptor.")
      .def_prop_ro("dim", &Encoder::dim, "Dimensions of a full code.")
      .def_prop_ro("dims", &Encoder::dims, "Lengths at which a code may be cut, ascending.")
      .def_prop_ro("scale", &Encoder::scale, "Real value of one code unit.")
      .def_prop_ro("identity", &Encoder::identity, "SHA-256 of the network, in hexadecimal.")
      .def_prop_ro("multiply_adds", &Encoder::multiply_adds, "Multiply-adds for one descriptor.")
      .def_prop_ro(
          "name", [](const Encoder& e) { return e.info().name; }, "Name of the model.")
      .def_prop_ro(
          "descriptor", [](const Encoder& e) { return e.info().descriptor; },
          "Name of the descriptor that it takes.")
      .def_prop_ro(
          "data", [](const Encoder& e) { return e.info().data; }, "What it was trained on.")
      .def_prop_ro(
          "licence", [](const Encoder& e) { return e.info().licence; }, "Licence of the model.")
      .def_prop_ro(
          "notes",
          [](const Encoder& e) {
            return std::map<std::string, std::string>(e.info().notes.begin(), e.info().notes.end());
          },
          "Whatever else the model says of itself.")
      .def(
          "acceptance",
          [](nb::object self, nb::object dim) {
            return nb::module_::import_("protomark.acceptance")
                .attr("Acceptance")
                .attr("of")(self, dim);
          },
          "dim"_a = nb::none(),
          nb::sig("def acceptance(self, dim: int | None = None) -> Acceptance"),
          R"(How likely a match is right, by the distances to the two nearest landmarks.

Args:
    dim: length of a code, one of `dims`; None: the full length.

Raises:
    ValueError: the encoder was not calibrated for codes of this length.)")
      .def_prop_ro(
          "layers",
          [](const Encoder& e) {
            nb::list result;
            for (std::size_t l = 0; l < e.layers().size(); ++l) {
              result.append(from_layer(e.layers()[l], l + 1 < e.layers().size()));
            }
            return result;
          },
          nb::sig("def layers(self) -> list[dict[str, Any]]"),
          "The integer layers, as the constructor takes them.")
      .def("__repr__", [](const Encoder& e) {
        return "<protomark.Encoder '" + e.info().name + "': " + std::to_string(e.bits()) +
               " bits -> " + std::to_string(e.dim()) + " int8>";
      });
}

void bind_open_map(nb::module_& m) {
  nb::class_<PrototypeMap> map(
      m, "PrototypeMap",
      "An open map: one prototype a landmark, or one for each of its looks, kept as an exact "
      "integer sum of codes, so that it follows every change without rounding.");
  map.def(
      "__init__",
      [](PrototypeMap* self, std::shared_ptr<Encoder> encoder, std::optional<std::size_t> dim,
         std::size_t look_bits) {
        if (dim == 0) throw nb::value_error("dim must be at least 1");
        new (self) PrototypeMap(std::move(encoder), dim.value_or(0), look_bits);
      },
      "encoder"_a, "dim"_a = nb::none(), "look_bits"_a = 0,
      nb::sig("def __init__(self, encoder: Encoder, dim: int | None = None, look_bits: int = 0) -> "
              "None"),
      R"(An empty map.

Args:
    encoder: makes codes of descriptors.
    dim: dimensions of a prototype, one of encoder.dims; None: all.
    look_bits: observations of a landmark whose codes differ in the sign of any of their first
        look_bits numbers are different looks of it, and each look has a prototype of its own. 0 to
        16 and at most dim; 0: one prototype a landmark.

Raises:
    ValueError: dim or look_bits is none of these.)");
  bind_reading(map);
  map.def_prop_rw(
      "metadata",
      [](const PrototypeMap& m) {
        return from_metadata(without_gil([&] { return m.metadata(); }));
      },
      [](PrototypeMap& m, nb::object metadata) {
        Metadata texts = to_metadata(metadata);
        const nb::gil_scoped_release release;
        m.set_metadata(std::move(texts));
      },
      nb::for_getter(nb::sig("def metadata(self) -> MappingProxyType[str, str]")),
      nb::for_setter(nb::sig("def metadata(self, metadata: Mapping[str, str], /) -> None")),
      R"(What the map says of itself: texts by name. A view; assign to change it:

    scene.metadata = scene.metadata | {"frame": "ENU, metres", "robot": "atlas-2"}

Names are free but for two: "frame" is the coordinate frame of the positions and their unit,
"created" is when the map was begun, "2026-11-23T03:39:41Z". A new map says nothing.

Raises:
    TypeError: a name or text is no str.
    ValueError: "created" is no such time, or something is beyond the limits (docs/limits.md).)");
  map.def_prop_ro("look_bits", &PrototypeMap::look_bits,
                  "Signs that tell the looks of a landmark apart; 0: it has one prototype.")
      .def(
          "counts",
          [](const PrototypeMap& m, nb::object ids) {
            const auto l = landmarks(ids);
            return counts(without_gil([&] { return m.counts(view(l)); }), m.look_bits() == 0);
          },
          "landmark_ids"_a,
          nb::sig("def counts(self, landmark_ids: ArrayLike) -> NDArray[numpy.uint8] | "
                  "NDArray[numpy.uint32]"),
          "Number of observations of each landmark, (n,) uint8; uint32, over all looks, where "
          "look_bits is not 0. Raises KeyError for an id that is not in the map.")
      .def(
          "looks",
          [](const PrototypeMap& m, std::int64_t id) {
            std::vector<std::vector<float>> means;
            auto looks = without_gil([&] { return m.looks(id); });
            for (Look& look : looks) means.push_back(std::move(look.mean));
            return stacked(means, m.dim());
          },
          "landmark_id"_a, nb::sig("def looks(self, landmark_id: int) -> NDArray[numpy.float32]"),
          "Mean codes of the looks of one landmark, (r, dim) float32, in code units; r is 1 where "
          "look_bits is 0. Raises KeyError for an id that is not in the map.")
      .def(
          "look_counts",
          [](const PrototypeMap& m, std::int64_t id) {
            std::vector<std::uint8_t> result;
            for (const Look& look : without_gil([&] { return m.looks(id); })) {
              result.push_back(static_cast<std::uint8_t>(look.count));
            }
            return new_vector(std::move(result));
          },
          "landmark_id"_a,
          nb::sig("def look_counts(self, landmark_id: int) -> NDArray[numpy.uint8]"),
          "Number of observations of each of these looks, (r,) uint8. Raises KeyError for an id "
          "that is not in the map.");

  const auto change = [](auto method) {
    return [method](PrototypeMap& self, nb::object ids, nb::object array, int threads) {
      const auto l = landmarks(ids);
      const auto d = descriptors(array);
      const nb::gil_scoped_release release;
      (self.*method)(view(l), view(d), threads);
    };
  };
  const auto change_codes = [](auto method) {
    return [method](PrototypeMap& self, nb::object ids, nb::object array) {
      const auto l = landmarks(ids);
      const auto c = codes(array);
      const nb::gil_scoped_release release;
      (self.*method)(view(l), view(c));
    };
  };
  map.def("add", change(&PrototypeMap::add), "landmark_ids"_a, "descriptors"_a, "threads"_a = 1,
          nb::sig("def add(self, landmark_ids: ArrayLike, descriptors: NDArray[numpy.uint8], "
                  "threads: int = 1) -> None"),
          R"(Add observations (Komorowski and Trzcinski, Eq. 1 and Eq. 2).

Args:
    landmark_ids: (n,) int64, not negative; unknown ones are new landmarks.
    descriptors: (n, bits / 8) uint8.
    threads: threads to encode on.

A landmark with 255 observations has its sum and count halved before one more is added.

Raises:
    TypeError: descriptors are not (n, bits / 8) uint8, or ids not integers.
    ValueError: descriptors are of another size than the encoder's, there are not as many ids, an id
        is negative, or threads is below 1. The map stays as it was.)")
      .def("remove", change(&PrototypeMap::remove), "landmark_ids"_a, "descriptors"_a,
           "threads"_a = 1,
           nb::sig("def remove(self, landmark_ids: ArrayLike, descriptors: NDArray[numpy.uint8], "
                   "threads: int = 1) -> None"),
           R"(Take observations back, exactly; a landmark without observations leaves the map.

Raises:
    KeyError: a landmark is not in the map.
    ValueError: these observations cannot have been added. Nothing is changed then.)")
      .def("add_codes", change_codes(&PrototypeMap::add_codes), "landmark_ids"_a, "codes"_a,
           nb::sig(
               "def add_codes(self, landmark_ids: ArrayLike, codes: NDArray[numpy.int8]) -> None"),
           "Like add, for descriptors that are encoded already: (n, dim) int8.")
      .def("remove_codes", change_codes(&PrototypeMap::remove_codes), "landmark_ids"_a, "codes"_a,
           nb::sig("def remove_codes(self, landmark_ids: ArrayLike, codes: NDArray[numpy.int8]) -> "
                   "None"),
           "Like remove, for descriptors that are encoded already: (n, dim) int8.")
      .def(
          "merge",
          [](PrototypeMap& self, nb::object into, nb::object source) {
            const auto a = landmarks(into);
            const auto b = landmarks(source);
            const nb::gil_scoped_release release;
            self.merge(view(a), view(b));
          },
          "into"_a, "source"_a,
          nb::sig("def merge(self, into: ArrayLike, source: ArrayLike) -> None"),
          "Join each source landmark to the one in `into`, exactly as if all observations had been "
          "of that one; the sources leave the map. Raises KeyError for an unknown id.")
      .def(
          "discard",
          [](PrototypeMap& self, nb::object ids) {
            const auto l = landmarks(ids);
            const nb::gil_scoped_release release;
            self.discard(view(l));
          },
          "landmark_ids"_a, nb::sig("def discard(self, landmark_ids: ArrayLike) -> None"),
          "Forget landmarks. Raises KeyError for an unknown id.")
      .def(
          "update",
          [](PrototypeMap& self, const PrototypeMap& other, std::optional<nb::object> into,
             std::optional<nb::object> source) {
            if (into.has_value() != source.has_value()) {
              throw nb::value_error("into and source go together");
            }
            const nb::object none = nb::make_tuple();
            const auto a = landmarks(into.value_or(none));
            const auto b = landmarks(source.value_or(none));
            const nb::gil_scoped_release release;
            self.update(other, view(a), view(b));
          },
          "other"_a, "into"_a = nb::none(), "source"_a = nb::none(),
          nb::sig("def update(self, other: PrototypeMap, into: ArrayLike | None = None, "
                  "source: ArrayLike | None = None) -> None"),
          R"(Join another map, exactly as if its observations had been added here.

Landmarks of one id are one landmark: those that both maps have are summed, the rest taken over.
Where the other map numbers its landmarks differently, say how:
`scene.update(other, into=ours, source=theirs)`. All of them under new ids:
`scene.update(other, into=other.ids + scene.ids[-1] + 1, source=other.ids)`.

Args:
    other: a map of the same encoder, dim and look_bits; it does not change.
    into: (n,) int64, ids in this map, known or new; several landmarks of the other map may become
        the same one.
    source: (n,) int64, their ids in the other map, each once. Landmarks that are not named keep
        their ids.

A landmark keeps its position, or takes the other one's where it has none; of several those with
the smallest id there. Metadata under names that this map lacks is taken over, and "created" becomes
the earlier.

Raises:
    KeyError: a source is not in the other map.
    ValueError: encoder, dim or look_bits differ, a source is named twice, or an id of `into` is
        negative. Nothing is changed then.)")
      .def(
          "split",
          [](const PrototypeMap& self, nb::object ids) {
            const auto boundaries = landmarks(ids);
            return without_gil([&] { return self.split(view(boundaries)); });
          },
          "ids"_a, nb::sig("def split(self, ids: ArrayLike) -> list[PrototypeMap]"),
          R"(Parts by id, as open maps of their own.

Args:
    ids: ascending ids at which a new part begins: `split([10, 20])` gives the landmarks below 10,
        those from 10 to 19, and those from 20 on.

Parts have all that this map knows of their landmarks, but no index. An empty map that is updated
with all of them, in any order, gives the same file as this one without its index. Together they
take as much memory.

Raises:
    ValueError: ids do not ascend.)")
      .def(
          "split",
          [](const PrototypeMap& self, double cell_size) {
            std::vector<MapPart> parts = without_gil([&] { return self.split(cell_size); });
            nb::dict result;
            for (MapPart& part : parts) {
              nb::object cell = nb::none();
              if (part.cell) {
                cell = nb::make_tuple((*part.cell)[0], (*part.cell)[1], (*part.cell)[2]);
              }
              result[cell] = nb::cast(std::move(part.map));
            }
            return result;
          },
          nb::kw_only(), "cell_size"_a,
          nb::sig("def split(self, *, cell_size: float) -> dict[tuple[int, int, int] | None, "
                  "PrototypeMap]"),
          R"(Parts by space, as open maps of their own.

Args:
    cell_size: edge of the cubes into which space is cut, in the unit of the positions.

Returns:
    A map for each cube (i, j, k) that has landmarks, those whose coordinates are from i to i + 1
    times cell_size and so on, ascending; and under None one of the landmarks without a position,
    where there are any.

Raises:
    ValueError: cell_size is not above 0, or too small for the map's extent.)")
      .def(
          "set_positions",
          [](PrototypeMap& self, nb::object ids, nb::object positions) {
            const auto l = landmarks(ids);
            const auto p = to_positions(positions);
            const nb::gil_scoped_release release;
            self.set_positions(view(l), p);
          },
          "landmark_ids"_a, "positions"_a,
          nb::sig("def set_positions(self, landmark_ids: ArrayLike, positions: ArrayLike) -> None"),
          "Set world coordinates, (n, 3) float64; NaN takes a position away. Raises KeyError for "
          "an "
          "unknown id.")
      .def("build_index", &PrototypeMap::build_index, "cells"_a = nb::none(), "threads"_a = 1,
           "in_place"_a = false, ReleaseGil(),
           nb::sig("def build_index(self, cells: int | None = None, threads: int = 1, "
                   "in_place: bool = False) -> None"),
           R"(Learn coarse cells from the map's prototypes, for search with recall or probes.

Prototypes are kept by cell from then on, through every change. Once more: learns anew.

Args:
    cells: number of cells, 1 to 65536 and at most that of prototypes; None: one that fits the map.
    threads: threads to use.
    in_place: False: prototypes are put into cells beside the map, which takes as much memory again,
        and searches go on. True: they change places within it, which takes 5 to 10 bytes a
        prototype, and once the map's largest array (2 dim bytes a prototype) where that has no room
        for half-filled blocks; searches wait while they do. The result is the same.

Raises:
    ValueError: cells is none of these, or the map is empty.
    MemoryError: memory ran out; the map is as before.)")
      .def("drop_index", &PrototypeMap::drop_index, ReleaseGil(),
           nb::sig("def drop_index(self) -> None"), "Forget the cells.")
      .def(
          "probes", &PrototypeMap::probes, "recall"_a, "threads"_a = 1, ReleaseGil(),
          nb::sig("def probes(self, recall: float, threads: int = 1) -> int"),
          "Number of cells that are searched for a recall in (0, 1], as measured on the map: "
          "prototypes are searched for among those of other landmarks, and codes as far from them "
          "as observations are among all (docs/index.md). Measured once, and again when a tenth of "
          "the map has changed. Raises ValueError for another recall, and without an index.")
      .def(
          "save", &PrototypeMap::save, "path"_a, ReleaseGil(),
          nb::sig("def save(self, path: str | os.PathLike[str]) -> None"),
          R"(Write the map, whole or not at all. Onto its own file, where it has a journal: compact.

Raises:
    FileError: the file cannot be written, or its journal is in use or holds commits, which would be
        lost.)")
      .def_prop_ro("has_journal", &PrototypeMap::has_journal, ReleaseGil(),
                   "Whether the map was opened with a journal, and not closed since.")
      .def("commit", &PrototypeMap::commit, ReleaseGil(), nb::sig("def commit(self) -> int"),
           R"(Make all changes up to here last, in the journal beside the map file.

The cost grows with the number of landmarks that changed, not with the map. Once this has returned,
opening the file gives this map, whatever happens to the process or the power. If it is interrupted,
opening gives this map or the one of the commit before.

Returns:
    Bytes written; 0 where nothing has changed.

Raises:
    FileError: the journal cannot be written, for example on a full disk. The map in memory is as
        before, and a later commit takes everything.
    ValueError: the map has no journal (open(path, journal=True)).)")
      .def(
          "compact", &PrototypeMap::compact, ReleaseGil(), nb::sig("def compact(self) -> None"),
          "Write the map file anew, with all changes, and empty the journal. If it is interrupted, "
          "opening gives this map or the one of the last commit. Raises FileError where the map "
          "file cannot be written, and ValueError where the map has no journal. Where only the "
          "journal cannot be emptied it returns: everything is in the map file, what is left in "
          "the journal holds nothing, and the next commit tries again.")
      .def("close", &PrototypeMap::close, ReleaseGil(), nb::sig("def close(self) -> None"),
           "Give the journal back, so that another map can be opened with it; the map stays in "
           "memory, without a journal. What was not committed is not in the file.")
      .def(
          "__enter__", [](PrototypeMap& self) -> PrototypeMap& { return self; },
          nb::rv_policy::reference, nb::sig("def __enter__(self) -> PrototypeMap"),
          "The map, to be closed at the end of the block.")
      .def(
          "__exit__",
          [](PrototypeMap& self, nb::object type, nb::object, nb::object) {
            const nb::gil_scoped_release release;
            if (self.has_journal() && type.is_none()) self.commit();
            self.close();
          },
          "type"_a.none(), "value"_a.none(), "traceback"_a.none(),
          nb::sig("def __exit__(self, type: object, value: object, traceback: object) -> None"),
          "Commit where the block ended without an exception, and close. Where committing fails, "
          "the map "
          "stays open, so that one may try again.")
      .def(
          "seal",
          [](const PrototypeMap& self, const Path& path, int bits, std::optional<double> prototypes,
             int position_bits) {
            const nb::gil_scoped_release release;
            self.seal(path, bits, prototypes, position_bits);
            return SealedMap(path);
          },
          "path"_a, "bits"_a = 8, "prototypes"_a = nb::none(), "position_bits"_a = 32,
          nb::sig("def seal(self, path: str | os.PathLike[str], bits: int = 8, prototypes: float | "
                  "None = None, position_bits: int = 32) -> SealedMap"),
          R"(Write a sealed map, whole or not at all, and open it.

Args:
    path: the file to write.
    bits: bits of a prototype's number. With 8 the sealed map gives the same answers; with 4 numbers
        are rounded to the 16 levels that fit this map best, and take half the bytes.
    prototypes: the largest number of prototypes that a landmark has on average, at least 1. Looks
        of a landmark are joined, over the whole map those first whose joining adds least to the
        squared distances of observations to their prototypes (Ward's criterion), until it fits.
        None: every look is kept (of one landmark at most 255).
    position_bits: bits of a coordinate. With 32, positions are floats relative to the middle of the
        map; with 16 they take half the bytes, as whole steps along each axis of the box around
        them, 65534 from end to end (position_error).

Raises:
    FileError: the file cannot be written, or an open map's journal beside it is in use or holds
        commits, which would be lost.
    ValueError: bits is neither 8 nor 4, prototypes is below 1, position_bits is neither 32 nor 16,
        or positions are further than 3.4e38 from their middle.)")
      .def("__repr__", [](const PrototypeMap& self) {
        return "<protomark.PrototypeMap: " + describe_size(self) + ", " +
               std::to_string(self.dim()) + " dimensions, encoder '" + self.encoder()->info().name +
               "'>";
      });
}

void bind_sealed_map(nb::module_& m) {
  nb::class_<SealedMap> map(m, "SealedMap",
                            "A map that only answers, mapped from its file: dim * code_bits / 8 + "
                            "1 bytes a landmark, and its position. Where landmarks have several "
                            "prototypes, dim * code_bits / 8 bytes each, and 2 a landmark.");
  bind_reading(map);
  map.def(
         "counts",
         [](const SealedMap& m, nb::object ids) {
           const auto l = landmarks(ids);
           return counts(without_gil([&] { return m.counts(view(l)); }), true);
         },
         "landmark_ids"_a,
         nb::sig("def counts(self, landmark_ids: ArrayLike) -> NDArray[numpy.uint8]"),
         "Number of observations of each landmark, at most 255, (n,) uint8. Raises KeyError for an "
         "id that is not in the map.")
      .def(
          "looks",
          [](const SealedMap& m, std::int64_t id) {
            return stacked(without_gil([&] { return m.looks(id); }), m.dim());
          },
          "landmark_id"_a, nb::sig("def looks(self, landmark_id: int) -> NDArray[numpy.float32]"),
          "Prototypes of one landmark, (r, dim) float32, in code units, with an index in no "
          "particular order. Raises KeyError for an id that is not in the map.")
      .def("probes", &SealedMap::probes, "recall"_a, ReleaseGil(),
           nb::sig("def probes(self, recall: float) -> int"),
           "Number of cells that are searched for a recall in (0, 1], as measured when the map was "
           "sealed. Raises ValueError for another recall, and without an index.");
  map.def_prop_ro(
      "metadata", [](const SealedMap& m) { return from_metadata(m.metadata()); },
      nb::sig("def metadata(self) -> MappingProxyType[str, str]"),
      "What the map says of itself: texts by name, as in the open map that was sealed.");
  map.def_prop_ro("position_bits", &SealedMap::position_bits,
                  "Bits of a position's coordinate: 32 or 16, 0 where no landmark has a position.")
      .def_prop_ro(
          "position_error",
          [](const SealedMap& m) -> nb::object {
            const auto error = m.position_error();
            if (!error) return nb::none();
            return new_vector(std::vector<double>(error->begin(), error->end()));
          },
          nb::sig("def position_error(self) -> NDArray[numpy.float64] | None"),
          "With 16-bit positions, how far they may be from those of the open map along each axis, "
          "(3,) float64: half a step. None otherwise: float32 are relative to the middle of the "
          "map.");
  map.def_prop_ro("code_bits", &SealedMap::code_bits,
                  "Bits of a prototype's number: 8, or 4 where the map was sealed so.");
  map.def("__repr__", [](const SealedMap& self) {
    return "<protomark.SealedMap: " + describe_size(self) + ", " + std::to_string(self.dim()) +
           " dimensions" + (self.code_bits() == 8 ? "" : " of 4 bits") + ", encoder '" +
           self.encoder()->info().name + "'>";
  });
}

// A path need not be UTF-8; its other bytes come back as Python keeps them.
void raise(PyObject* type, const std::exception& error) {
  const auto text = nb::steal(PyUnicode_DecodeFSDefault(error.what()));
  if (text.is_valid()) PyErr_SetObject(type, text.ptr());
}

void bind_errors() {
  nb::register_exception_translator([](const std::exception_ptr& p, void*) {
    try {
      std::rethrow_exception(p);
    } catch (const FileError& error) {
      const nb::object type = nb::module_::import_("protomark.errors").attr("FileError");
      raise(type.ptr(), error);
    } catch (const UnknownLandmark& error) {
      raise(PyExc_KeyError, error);
    } catch (const std::invalid_argument& error) {
      raise(PyExc_ValueError, error);
    }
  });
}

}  // namespace
}  // namespace protomark::python

NB_MODULE(_core, m) {
  using namespace protomark;
  using namespace protomark::python;
  m.doc() = "The C++ core of Protomark.";
  bind_errors();
  bind_encoder(m);
  bind_sealed_map(m);
  bind_open_map(m);
  m.def("hamming_search", &hamming, "queries"_a, "database"_a, "k"_a = 2,
        "landmarks"_a = nb::none(), "max_distance"_a = nb::none(), "threads"_a = 1,
        nb::sig("def hamming_search(queries: NDArray[numpy.uint8], database: NDArray[numpy.uint8], "
                "k: int = 2, landmarks: ArrayLike | None = None, max_distance: int | None = None, "
                "threads: int = 1) -> tuple[NDArray[numpy.int64], NDArray[numpy.int32]]"),
        R"(Exact k nearest neighbours of binary descriptors in Hamming distance.

Args:
    queries: (q, bits / 8) uint8.
    database: (n, bits / 8) uint8.
    k: neighbours to return.
    landmarks: (n,) int64, the landmark of each row of database. With it, the k nearest *distinct*
        landmarks are returned, each as far away as its nearest descriptor.
    max_distance: neighbours further away, in bits, are left out.
    threads: threads to use.

Returns:
    Rows of database, or landmark ids, (q, k) int64, nearest first, ties to the smaller, -1 where
    there is none; and distances (q, k) int32, in bits, 2^31 - 1 where there is none.

Raises:
    TypeError: queries or database are not (rows, bits / 8) uint8.
    ValueError: queries and database are of different sizes, landmarks does not have an id for each
        row, k or threads is below 1, or max_distance is negative.)");
  m.def("instruction_set", &instruction_set,
        "The instruction set in use, for example avx512; the environment variable PROTOMARK_ISA "
        "chooses another one. All give the same bytes.");
  // Before a journal is made for the map, or anything large is read.
  const auto check_map = [](const Path& path, const Encoder* encoder,
                            const std::optional<std::string>& descriptor) {
    if (encoder == nullptr && !descriptor) return;
    without_gil([&] {
      const auto own = map_encoder(path);
      if (encoder != nullptr) expect_encoder(*own, *encoder, path.string());
      if (descriptor) expect_descriptor(*own, *descriptor, path.string());
    });
  };
  // What can commit is an open map, which type checkers are told.
  m.def(
      "open",
      [check_map](const Path& path, bool journal, const Encoder* encoder,
                  const std::optional<std::string>& descriptor) {
        if (!journal) throw nb::next_overload();
        check_map(path, encoder, descriptor);
        return without_gil([&] { return PrototypeMap::load(path, true); });
      },
      "path"_a, nb::kw_only(), "journal"_a, "encoder"_a.none() = nb::none(),
      "descriptor"_a = nb::none(),
      nb::sig("def open(path: str | os.PathLike[str], *, journal: Literal[True], "
              "encoder: Encoder | None = None, descriptor: str | None = None) -> PrototypeMap"));
  m.def(
      "open",
      [check_map](const Path& path, bool, const Encoder* encoder,
                  const std::optional<std::string>& descriptor) -> nb::object {
        check_map(path, encoder, descriptor);
        if (without_gil([&] { return map_kind(path); }) == MapKind::open) {
          return nb::cast(without_gil([&] { return PrototypeMap::load(path); }));
        }
        return nb::cast(without_gil([&] { return SealedMap(path); }));
      },
      "path"_a, nb::kw_only(), "journal"_a = false, "encoder"_a.none() = nb::none(),
      "descriptor"_a = nb::none(),
      nb::sig("def open(path: str | os.PathLike[str], *, journal: bool = False, "
              "encoder: Encoder | None = None, descriptor: str | None = None) -> PrototypeMap | "
              "SealedMap"),
      R"(Open a map file: an open map is read, with what was committed to its journal; a sealed one
is mapped.

A map encodes descriptors itself, with the encoder that it was built with. Where they are encoded
elsewhere, or come from a detector that the map has not seen, say what you have:

Args:
    path: the map file.
    journal: the map is the one that may commit to the journal beside the file, which is made where
        there is none. No other map can be opened so until this one is closed or gone.
    encoder: the map must have been made with this encoder, or one of equal identity.
    descriptor: the map must be one of this descriptor, for example "orb".

Raises:
    FileError: the file is no map, or broken; with journal also where it is sealed, or where another
        map has the journal.
    ValueError: the map is of another encoder or descriptor.)");
  m.def("file_sections", &file_sections, "path"_a, ReleaseGil(),
        nb::sig("def file_sections(path: str | os.PathLike[str]) -> list[tuple[str, int]]"),
        "Names and sizes in bytes of the sections of a model or map file. Raises FileError.");
  m.def("verify_file", &verify_file, "path"_a, ReleaseGil(),
        nb::sig("def verify_file(path: str | os.PathLike[str]) -> None"),
        "Check every checksum of a model or map file, and of the journal beside it. Raises "
        "FileError.");
  m.def(
      "file_journal",
      [](const Path& path) -> nb::object {
        const auto journal = without_gil([&] { return file_journal(path); });
        if (!journal) return nb::none();
        nb::dict result;
        result["commits"] = journal->commits;
        result["bytes"] = journal->bytes;
        result["torn_bytes"] = journal->torn_bytes;
        return result;
      },
      "path"_a, nb::sig("def file_journal(path: str | os.PathLike[str]) -> dict[str, int] | None"),
      "The journal beside a map file: commits since the file was written, bytes, and how many of "
      "these are of an interrupted commit, which is not there. None: there is no journal. Raises "
      "FileError.");
}
