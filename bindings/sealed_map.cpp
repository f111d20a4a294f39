// SealedMap.
#include "protomark/sealed_map.h"

#include "module.h"
#include "search.h"

namespace protomark::python {

nb::dict from_summary(const MapSummary& summary, bool counted) {
  nb::dict result;
  if (counted) {
    result["observations"] = summary.observations;
    const auto& counts = summary.count_histogram;
    result["count_histogram"] = to_numpy(std::vector<std::int64_t>(counts.begin(), counts.end()));
  }
  result["landmarks_with_position"] = summary.landmarks_with_position;
  result["extent"] = nb::none();
  if (const auto& extent = summary.extent) {
    result["extent"] = to_numpy(std::vector<Position>(extent->begin(), extent->end()));
  }
  return result;
}

void bind_sealed_map(nb::module_& m) {
  nb::class_<SealedMap> map(
      m, "SealedMap",
      "A map that only answers, mapped from its file into memory that processes share.");
  bind_answers(map);
  map.def("nprobe", &SealedMap::nprobe, "recall"_a, ReleaseGil(),
          "Number of inverted lists that a search with this recall, in (0, 1], visits, as measured "
          "when the map was sealed. Raises ValueError for another recall, and without an index.")
      .def_prop_ro(
          "metadata", [](const SealedMap& m) { return from_metadata(m.metadata()); },
          nb::sig("def metadata(self) -> MappingProxyType[str, str]"),
          "What the map says of itself: texts by name, as in the learning map that was sealed.")
      .def_prop_ro("words", &SealedMap::words,
                   "Words of the encoder's codebook per prototype; 0: prototypes are int8 numbers, "
                   "as in the learning map.")
      .def_prop_ro("tuned", &SealedMap::tuned,
                   "Whether prototypes were tuned against each other (PrototypeMap.seal).")
      .def_prop_ro("bytes_per_landmark", &SealedMap::bytes_per_landmark,
                   "Bytes that a landmark takes on average for its prototypes and their number, as "
                   "PrototypeMap.seal counts them.")
      .def_prop_ro("position_bits", &SealedMap::position_bits,
                   "Bits per coordinate: 32 or 16, or 0 if no landmark has a position.")
      .def_prop_ro(
          "position_error",
          [](const SealedMap& m) -> nb::object {
            const auto error = m.position_error();
            if (!error) return nb::none();
            return to_numpy(std::vector<double>(error->begin(), error->end()));
          },
          nb::sig("def position_error(self) -> NDArray[numpy.float64] | None"),
          "With 16-bit positions, how far they may be from those of the learning map along each "
          "axis, (3,) float64. None otherwise: float32 are relative to the middle of the map.")
      .def("__repr__", [](const SealedMap& self) {
        return "<protomark.SealedMap: " + describe_map(self) +
               (self.words() == 0 ? ">" : ", " + std::to_string(self.words()) + " words>");
      });
}

}  // namespace protomark::python
