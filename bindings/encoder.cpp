// Encoder.
#include "protomark/encoder.h"

#include <nanobind/stl/map.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <map>

#include "module.h"
#include "protomark/matching.h"

namespace protomark::python {
namespace {

Layer to_layer(nb::dict d, bool last) {
  const auto weights =
      array_of<Array2<std::int8_t>>(d["weights"], "int8", 2, "weights: a (out, in) int8");
  const auto bias = array_of<Array1<std::int32_t>>(d["bias"], "int32", 1, "bias: a (out,) int32");
  const auto multipliers =
      array_of<Array1<std::int32_t>>(d["multipliers"], "int32", 1, "multipliers: a (out,) int32");
  Layer layer;
  layer.outputs = weights.shape(0);
  layer.inputs = weights.shape(1);
  layer.weights.assign(weights.data(), weights.data() + weights.size());
  layer.bias.assign(bias.data(), bias.data() + bias.size());
  layer.multipliers.assign(multipliers.data(), multipliers.data() + multipliers.size());
  layer.shift = integer<int>(d["shift"], "shift");
  const nb::object table = d["table"];
  if (table.is_none()) {
    if (!last) throw nb::value_error("a hidden layer needs a table, only the last one has None");
    return layer;
  }
  if (last) throw nb::value_error("the last layer has no table");
  const auto bytes = array_of<Array1<std::uint8_t>>(table, "uint8", 1, "table: a (256,) uint8");
  if (bytes.size() != layer.table.size()) {
    throw nb::value_error("a layer's table must have 256 entries");
  }
  std::copy_n(bytes.data(), bytes.size(), layer.table.begin());
  return layer;
}

nb::dict from_layer(const Layer& layer, bool last) {
  Matrix<std::int8_t> weights(layer.outputs, layer.inputs);
  weights.data = layer.weights;
  nb::dict d;
  d["weights"] = to_numpy(std::move(weights));
  d["bias"] = to_numpy(layer.bias);
  d["multipliers"] = to_numpy(layer.multipliers);
  d["shift"] = layer.shift;
  d["table"] = last ? nb::none()
                    : to_numpy(std::vector<std::uint8_t>(layer.table.begin(), layer.table.end()));
  return d;
}

std::vector<Codebook> to_codebooks(nb::handle codebooks) {
  std::vector<Codebook> result;
  for (nb::handle codebook : codebooks) {
    const auto words = array_of<Array3<std::int8_t>>(
        codebook, "int8", 3, "codebooks: each must be a (subspaces, 256, width) int8");
    if (words.shape(1) != Codebook::kWords) {
      throw nb::value_error("a codebook has 256 words for each subspace");
    }
    result.push_back({words.shape(2), {words.data(), words.data() + words.size()}});
  }
  return result;
}

nb::list from_codebooks(const std::vector<Codebook>& codebooks) {
  nb::list result;
  for (const auto& [width, words] : codebooks) {
    Matrix<std::int8_t> numbers(words.size() / width, width);
    numbers.data = words;
    result.append(to_numpy(std::move(numbers)).attr("reshape")(-1, Codebook::kWords, width));
  }
  return result;
}

constexpr const char* kInputs[] = {"bits", "uint8", "float32"};

const char* input_name(const Encoder& encoder) {
  return kInputs[static_cast<std::size_t>(encoder.input().kind)];
}

EncoderInput to_input(const std::string& name, float scale) {
  const auto* found = std::ranges::find(kInputs, name);
  if (found == std::end(kInputs)) {
    throw std::invalid_argument("input must be bits, uint8 or float32, not '" + name + "'");
  }
  return {static_cast<InputKind>(found - kInputs), scale};
}

// A text of the encoder's info.
auto info(std::string EncoderInfo::* text) {
  return [text](const Encoder& encoder) { return encoder.info().*text; };
}

}  // namespace

void bind_encoder(nb::module_& m) {
  nb::class_<Encoder>(m, "Encoder",
                      "A network from descriptors to int8 codes that gives the same bytes on every "
                      "machine.")
      .def(
          "__init__",
          [](Encoder* self, nb::list layers, std::vector<std::size_t> dims, std::string name,
             std::string descriptor, float scale, std::string data, std::string licence,
             std::map<std::string, std::string> notes, nb::object codebooks,
             const std::string& input, float input_scale) {
            std::vector<Codebook> words = to_codebooks(codebooks);
            std::vector<Layer> built;
            for (nb::handle layer : layers) {
              if (!nb::isinstance<nb::dict>(layer)) type_error("layers: each must be a dict");
              built.push_back(
                  to_layer(nb::cast<nb::dict>(layer), built.size() + 1 == layers.size()));
            }
            EncoderInfo texts{std::move(name),
                              std::move(descriptor),
                              std::move(data),
                              std::move(licence),
                              {notes.begin(), notes.end()}};
            const nb::gil_scoped_release release;
            new (self) Encoder(std::move(texts), std::move(built), std::move(dims), scale,
                               std::move(words), to_input(input, input_scale));
          },
          "layers"_a, "dims"_a, "name"_a, "descriptor"_a, "scale"_a, "data"_a = "",
          "licence"_a = "", "notes"_a = nb::dict(), "codebooks"_a = nb::tuple(), "input"_a = "bits",
          "input_scale"_a = 0.0f,
          nb::sig(
              "def __init__(self, layers: list[dict[str, Any]], dims: Sequence[int], name: str, "
              "descriptor: str, scale: float, data: str = '', licence: str = '', "
              "notes: dict[str, str] = {}, codebooks: Sequence[NDArray[numpy.int8]] = (), "
              "input: str = 'bits', input_scale: float = 0.0) -> None"),
          R"(Build an encoder from integer layers.

Args:
    layers: each a dict of weights (out, in) int8, bias (out,) int32, multipliers (out,) int32,
        shift, and table (256,) uint8, None in the last layer; docs/format.md says what is computed.
    dims: lengths at which a code may be cut, ascending, the last one its full length.
    name, descriptor, data, licence, notes: what the model says of itself. No note may have the key
        name, descriptor, data or licence.
    scale: real value of one code unit.
    codebooks: each (subspaces, 256, width) int8, -127 to 127: the words by which sealed maps write
        prototypes, a byte for each `width` numbers, 1 to 4 (product quantization, Jegou et al.
        2011). Widths are distinct.
    input: what descriptors consist of, bits, uint8 or float32 numbers.
    input_scale: float32 numbers are quantised as bytes, clip(rint(x * input_scale), -127, 127) +
        128; 0 for other inputs.

Raises:
    TypeError: an array is of another type.
    ValueError: layers, codebooks or input do not fit together, or a note has such a key.)")
      .def(
          "with_codebooks",
          [](const Encoder& e, nb::object codebooks) {
            return Encoder(e.info(), e.layers(), e.dims(), e.scale(), to_codebooks(codebooks),
                           e.input());
          },
          "codebooks"_a,
          nb::sig("def with_codebooks(self, codebooks: Sequence[NDArray[numpy.int8]]) -> Encoder"),
          "This encoder with other codebooks, as the constructor takes them; its codes and "
          "identity "
          "stay.")
      .def_static("load", &Encoder::load, "path"_a, ReleaseGil(), "Load a model file.")
      .def("save", &Encoder::save, "path"_a, ReleaseGil(),
           nb::sig("def save(self, path: str | os.PathLike[str]) -> None"),
           "Write the model file, whole or not at all. Raises FileError.")
      .def(
          "encode",
          [](const Encoder& encoder, nb::object array, nb::object dim, nb::object threads) {
            const auto d = descriptors(array, encoder);
            const std::size_t length = code_length(dim);
            const auto workers = integer<int>(threads, "threads");
            return to_numpy(without_gil([&] { return encoder.encode(view(d), length, workers); }));
          },
          "descriptors"_a.none(), "dim"_a.none() = nb::none(), "threads"_a.none() = 1,
          nb::sig(
              "def encode(self, descriptors: NDArray[numpy.uint8 | numpy.float32], dim: int | None "
              "= None, threads: int = 1) -> NDArray[numpy.int8]"),
          R"(Encode descriptors.

Args:
    descriptors: by `input`: bits, (n, bits / 8) uint8, the bytes that OpenCV gives; uint8 or
        float32, (n, inputs) of that type.
    dim: length of a code, one of `dims`; None means the full length.
    threads: threads to use.

Returns:
    (n, dim) int8, -127 to 127.

Raises:
    TypeError: descriptors are of another type.
    ValueError: they are of another size than the encoder's, a vector has a NaN or an infinity or is
        all zeros (once quantised), dim is none of `dims`, or threads is below 1.)")
      .def(
          "match_calibration",
          [](const Encoder& encoder, nb::object dim, bool tuned) {
            return MatchCalibration::of(encoder, code_length(dim), tuned);
          },
          "dim"_a.none() = nb::none(), "tuned"_a = false,
          nb::sig("def match_calibration(self, dim: int | None = None, tuned: bool = False) -> "
                  "MatchCalibration"),
          "How likely a match is right, by the distances to the two nearest landmarks, for codes "
          "of `dim` numbers, one of `dims` (None: the full length), in a map of mean or of tuned "
          "prototypes. Raises ValueError if the encoder was not calibrated for these.")
      .def_prop_ro("input", &input_name, "What descriptors consist of: bits, uint8 or float32.")
      .def_prop_ro("inputs", &Encoder::inputs, "Bits or numbers of a descriptor.")
      .def_prop_ro(
          "input_scale", [](const Encoder& e) { return e.input().scale; },
          "What float32 numbers are multiplied by before they are rounded; 0 for other inputs.")
      .def_prop_ro("bytes", &Encoder::bytes, "Bytes of a descriptor in memory.")
      .def_prop_ro("bits", &Encoder::bits, "Bits of a descriptor in memory.")
      .def_prop_ro("dim", &Encoder::dim, "Dimensions of a full code.")
      .def_prop_ro("dims", &Encoder::dims, "Lengths at which a code may be cut, ascending.")
      .def_prop_ro("scale", &Encoder::scale, "Real value of one code unit.")
      .def_prop_ro(
          "codebooks", [](const Encoder& e) { return from_codebooks(e.codebooks()); },
          nb::sig("def codebooks(self) -> list[NDArray[numpy.int8]]"),
          "Words of prototypes in sealed maps, (subspaces, 256, width) each, as the constructor "
          "takes them.")
      .def_prop_ro("identity", &Encoder::identity, "SHA-256 of the network, in hexadecimal.")
      .def_prop_ro("multiply_adds", &Encoder::multiply_adds, "Multiply-adds per descriptor.")
      .def_prop_ro("name", info(&EncoderInfo::name), "Name of the model.")
      .def_prop_ro("descriptor", info(&EncoderInfo::descriptor),
                   "Name of the descriptor that it takes.")
      .def_prop_ro("data", info(&EncoderInfo::data), "What it was trained on.")
      .def_prop_ro("licence", info(&EncoderInfo::licence), "Licence of the model.")
      .def_prop_ro(
          "notes",
          [](const Encoder& e) {
            return std::map<std::string, std::string>(e.info().notes.begin(), e.info().notes.end());
          },
          "Whatever else the model says of itself.")
      .def_prop_ro(
          "layers",
          [](const Encoder& e) {
            nb::list result;
            for (const Layer& layer : e.layers()) {
              result.append(from_layer(layer, &layer == &e.layers().back()));
            }
            return result;
          },
          nb::sig("def layers(self) -> list[dict[str, Any]]"),
          "The integer layers, as the constructor takes them.")
      .def("__repr__", [](const Encoder& e) {
        return "<protomark.Encoder '" + e.info().name + "': " + std::to_string(e.inputs()) + " " +
               input_name(e) + " -> " + std::to_string(e.dim()) + " int8>";
      });
}

}  // namespace protomark::python
