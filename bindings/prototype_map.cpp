// PrototypeMap.
#include "protomark/prototype_map.h"

#include <nanobind/stl/vector.h>

#include "module.h"
#include "protomark/sealed_map.h"
#include "search.h"

namespace protomark::python {
namespace {

// Bind a function that takes ids and as many descriptors, or codes.
auto change(void (PrototypeMap::*method)(std::span<const std::int64_t>, Descriptors, int)) {
  return [method](PrototypeMap& self, nb::object ids, nb::object array, nb::object threads) {
    const auto l = landmark_ids(ids);
    const auto d = descriptors(array, *self.encoder());
    const auto workers = integer<int>(threads, "threads");
    const nb::gil_scoped_release release;
    (self.*method)(view(l), view(d), workers);
  };
}
auto change(void (PrototypeMap::*method)(std::span<const std::int64_t>, Codes)) {
  return [method](PrototypeMap& self, nb::object ids, nb::object array) {
    const auto l = landmark_ids(ids);
    const auto c = codes(array);
    const nb::gil_scoped_release release;
    (self.*method)(view(l), view(c));
  };
}

void bind_changes(nb::class_<PrototypeMap>& map) {
  map.def("add", change(&PrototypeMap::add), "landmark_ids"_a, "descriptors"_a.none(),
          "threads"_a.none() = 1,
          nb::sig("def add(self, landmark_ids: ArrayLike, descriptors: NDArray[numpy.uint8 | "
                  "numpy.float32], threads: int = 1) -> None"),
          R"(Add observations (Komorowski and Trzcinski, Eq. 1 and Eq. 2).

Args:
    landmark_ids: (n,) int64, not negative; ids that the map does not hold are new landmarks.
    descriptors: as Encoder.encode takes them.
    threads: threads to encode on.

A prototype with 255 observations has its sum and count halved before one more is added.

Raises:
    TypeError: descriptors are of another type than the encoder's, or ids not integers.
    ValueError: the encoder refuses the descriptors, there are not as many ids, an id is negative,
        or threads is below 1. The map stays as it was.)")
      .def("subtract", change(&PrototypeMap::subtract), "landmark_ids"_a, "descriptors"_a.none(),
           "threads"_a.none() = 1,
           nb::sig("def subtract(self, landmark_ids: ArrayLike, descriptors: NDArray[numpy.uint8 | "
                   "numpy.float32], threads: int = 1) -> None"),
           R"(Undo `add`, exactly; a landmark without observations leaves the map.

Raises:
    KeyError: a landmark is not in the map.
    ValueError: these observations cannot have been added. Nothing is changed then.)")
      .def("add_codes", change(&PrototypeMap::add_codes), "landmark_ids"_a, "codes"_a.none(),
           nb::sig(
               "def add_codes(self, landmark_ids: ArrayLike, codes: NDArray[numpy.int8]) -> None"),
           "Like add, for descriptors that are encoded already: (n, dim) int8.")
      .def("subtract_codes", change(&PrototypeMap::subtract_codes), "landmark_ids"_a,
           "codes"_a.none(),
           nb::sig("def subtract_codes(self, landmark_ids: ArrayLike, codes: NDArray[numpy.int8]) "
                   "-> None"),
           "Like subtract, for descriptors that are encoded already: (n, dim) int8.")
      .def(
          "remove",
          [](PrototypeMap& self, nb::object ids) {
            const auto l = landmark_ids(ids);
            const nb::gil_scoped_release release;
            self.remove(view(l));
          },
          "landmark_ids"_a, nb::sig("def remove(self, landmark_ids: ArrayLike) -> None"),
          "Remove landmarks. Raises KeyError for an id that is not in the map.")
      .def(
          "merge_landmarks",
          [](PrototypeMap& self, nb::object into, nb::object source) {
            const auto a = landmark_ids(into);
            const auto b = landmark_ids(source);
            const nb::gil_scoped_release release;
            self.merge_landmarks(view(a), view(b));
          },
          "into"_a, "source"_a,
          nb::sig("def merge_landmarks(self, into: ArrayLike, source: ArrayLike) -> None"),
          "Merge each source landmark into the one in `into`, exactly as if all observations had "
          "been of that one; the sources leave the map. Raises KeyError for an id that is not in "
          "the map, and ValueError for a landmark that was merged before.")
      .def(
          "merge_map",
          [](PrototypeMap& self, const PrototypeMap& other, std::optional<nb::object> into,
             std::optional<nb::object> source) {
            if (into.has_value() != source.has_value()) {
              throw nb::value_error("into and source go together");
            }
            const nb::object none = nb::make_tuple();
            const auto a = landmark_ids(into.value_or(none));
            const auto b = landmark_ids(source.value_or(none));
            const nb::gil_scoped_release release;
            self.merge_map(other, view(a), view(b));
          },
          "other"_a, "into"_a = nb::none(), "source"_a = nb::none(),
          nb::sig("def merge_map(self, other: PrototypeMap, into: ArrayLike | None = None, "
                  "source: ArrayLike | None = None) -> None"),
          R"(Merge another map into this one, exactly as if its observations had been added here.

Landmarks of one id are one landmark: those that both maps hold are summed, the rest taken over.
If the other map numbers its landmarks differently, say how:
`scene.merge_map(other, into=ours, source=theirs)`. All of them under new ids:
`scene.merge_map(other, into=other.ids + scene.ids[-1] + 1, source=other.ids)`.

Args:
    other: a map of the same encoder, dim and appearance_bits; it does not change.
    into: (n,) int64, ids in this map, existing or new; several landmarks of the other map may
        become the same one.
    source: (n,) int64, their ids in the other map, each once. Landmarks that are not named keep
        their ids.

A landmark keeps its position, or takes the other one's if it has none; of several those with the
smallest id there. Metadata is taken over under names that this map lacks, and "created" becomes the
earlier one.

Raises:
    KeyError: a source is not in the other map.
    ValueError: encoder, dim or appearance_bits differ, a source is named twice, or an id of `into`
        is negative. Nothing is changed then.)")
      .def(
          "set_positions",
          [](PrototypeMap& self, nb::object ids, nb::object coordinates) {
            const auto l = landmark_ids(ids);
            const auto p = positions(coordinates);
            const nb::gil_scoped_release release;
            self.set_positions(view(l), p);
          },
          "landmark_ids"_a, "positions"_a,
          nb::sig("def set_positions(self, landmark_ids: ArrayLike, positions: ArrayLike) -> None"),
          "Set world coordinates, (n, 3) float64; NaN takes a position away. Raises KeyError for "
          "an id that is not in the map.")
      .def(
          "build_index",
          [](PrototypeMap& self, std::optional<std::size_t> nlist, int threads, bool in_place) {
            self.build_index({nlist, in_place}, threads);
          },
          "nlist"_a = nb::none(), "threads"_a = 1, "in_place"_a = false, ReleaseGil(),
          nb::sig("def build_index(self, nlist: int | None = None, threads: int = 1, "
                  "in_place: bool = False) -> None"),
          R"(Learn inverted lists from the map's prototypes, for search with recall or nprobe.

Prototypes are kept by list from then on, through every change. A second call learns anew.

Args:
    nlist: number of lists, 1 to 65536 and at most one per prototype; None: one that fits the map.
    threads: threads to use.
    in_place: False: prototypes are put into lists in a copy of the map, which takes as much memory
        again, and searches go on. True: they move within the map, which takes 5 to 10 bytes per
        prototype, and once the map's largest array (2 dim bytes per prototype) if that has no room
        for half-filled blocks; searches wait while they do. The result is the same.

Raises:
    ValueError: nlist is none of these, or the map is empty.
    MemoryError: memory ran out; the map is as before.)")
      .def("drop_index", &PrototypeMap::drop_index, ReleaseGil(), "Drop the index.");
}

void bind_parts(nb::class_<PrototypeMap>& map) {
  map.def(
      "distances",
      [](const PrototypeMap& self, nb::object ids, nb::object array) {
        const auto l = landmark_ids(ids);
        const auto c = codes(array);
        return to_numpy(without_gil([&] { return self.distances(view(l), view(c)); }));
      },
      "landmark_ids"_a, "codes"_a.none(),
      nb::sig("def distances(self, landmark_ids: ArrayLike, codes: NDArray[numpy.int8]) -> "
              "NDArray[numpy.int32]"),
      R"(Squared distance of each code to one landmark, as search measures it.

For guided matching, which knows near which landmarks a keypoint is.

Args:
    landmark_ids: (n,) int64.
    codes: (n, dim) int8.

Returns:
    (n,) int32.

Raises:
    KeyError: a landmark is not in the map.
    ValueError: there are not as many codes as landmarks, or they are of another length.)");
  map.def(
         "part",
         [](const PrototypeMap& self, nb::object ids) {
           const auto l = landmark_ids(ids);
           return without_gil([&] { return self.part(view(l)); });
         },
         "landmark_ids"_a, nb::sig("def part(self, landmark_ids: ArrayLike) -> PrototypeMap"),
         R"(Return a learning map of some landmarks, with all that this one knows of them.

Raises:
    KeyError: a landmark is not in the map.)")
      .def(
          "split_by_id",
          [](const PrototypeMap& self, nb::object ids) {
            const auto boundaries = landmark_ids(ids);
            return without_gil([&] { return self.split_by_id(view(boundaries)); });
          },
          "boundaries"_a,
          nb::sig("def split_by_id(self, boundaries: ArrayLike) -> list[PrototypeMap]"),
          R"(Return parts by id, as learning maps of their own.

Args:
    boundaries: ascending ids at which a new part begins: `split_by_id([10, 20])` gives the
        landmarks below 10, those from 10 to 19, and those from 20 on.

Parts have all that this map knows of their landmarks, but no index. All of them merged into an
empty map, in any order, give the same file as this one without its index. Together they take as
much memory.

Raises:
    ValueError: boundaries do not ascend.)")
      .def(
          "split_by_space",
          [](const PrototypeMap& self, double cell_size) {
            std::vector<MapPart> parts =
                without_gil([&] { return self.split_by_space(cell_size); });
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
          "cell_size"_a,
          nb::sig("def split_by_space(self, cell_size: float) -> dict[tuple[int, int, int] | None, "
                  "PrototypeMap]"),
          R"(Return parts by space, as learning maps of their own.

Args:
    cell_size: edge of the cubes into which space is cut, in the unit of the positions.

Returns:
    A map for each cube (i, j, k) that holds landmarks, those whose coordinates are from i to i + 1
    times cell_size and so on, ascending; and under None one of the landmarks without a position, if
    there are any.

Raises:
    ValueError: cell_size is not above 0, or too small for the map's extent.)");
}

void bind_journal(nb::class_<PrototypeMap>& map) {
  map.def("save", &PrototypeMap::save, "path"_a, ReleaseGil(),
          nb::sig("def save(self, path: str | os.PathLike[str]) -> None"),
          R"(Write the map, whole or not at all. Onto its own file, with a journal: compact.

Raises:
    FileError: the file cannot be written, or its journal is in use or holds commits, which would be
        lost.)")
      .def_prop_ro("has_journal", &PrototypeMap::has_journal, ReleaseGil(),
                   "Whether the map was opened with a journal, and not closed since.")
      .def("commit", &PrototypeMap::commit, ReleaseGil(),
           R"(Make all changes so far durable, in the journal beside the map file.

The cost grows with the number of landmarks that changed, not with the map. Once this has returned,
opening the file gives this map, whatever happens to the process or the power. If it is interrupted,
opening gives this map or the one of the commit before.

Returns:
    Bytes written; 0 if nothing has changed.

Raises:
    FileError: the journal cannot be written, for example on a full disk. The map in memory is as
        before, and a later commit takes everything.
    ValueError: the map has no journal (open(path, journal=True)).)")
      .def("compact", &PrototypeMap::compact, ReleaseGil(),
           "Write the map file anew, with all changes, and empty the journal. If it is "
           "interrupted, opening gives this map or the one of the last commit. Raises FileError if "
           "the map file cannot be written, and ValueError if the map has no journal. If only the "
           "journal cannot be emptied it returns: the map file holds everything, what is left in "
           "the journal no longer counts, and the next commit tries again.")
      .def("close", &PrototypeMap::close, ReleaseGil(),
           "Release the journal, so that another map can be opened with it; the map stays in "
           "memory, without a journal. What was not committed is not in the file.")
      .def(
          "__enter__", [](PrototypeMap& self) -> PrototypeMap& { return self; },
          nb::rv_policy::reference, nb::sig("def __enter__(self) -> PrototypeMap"),
          "The map, which is closed at the end of the block.")
      .def(
          "__exit__",
          [](PrototypeMap& self, nb::object type, nb::object, nb::object) {
            const bool failed = !type.is_none();
            const nb::gil_scoped_release release;
            if (self.has_journal() && !failed) self.commit();
            self.close();
          },
          "type"_a.none(), "value"_a.none(), "traceback"_a.none(),
          nb::sig("def __exit__(self, type: object, value: object, traceback: object) -> None"),
          "Commit if the block ended without an exception, and close. If committing fails the map "
          "stays open, so that one may try again.")
      .def(
          "seal",
          [](const PrototypeMap& self, const Path& path, nb::object ids, nb::object array,
             std::optional<double> bytes_per_landmark, int position_bits, bool tune, int threads) {
            const SealOptions options{bytes_per_landmark, position_bits, tune, threads};
            if (ids.is_none() != array.is_none()) {
              throw nb::value_error("landmark_ids and descriptors come together");
            }
            if (array.is_none()) {
              const nb::gil_scoped_release release;
              self.seal(path, options);
            } else if (is_int8(array)) {
              const auto l = landmark_ids(ids);
              const auto c = codes(array);
              const nb::gil_scoped_release release;
              self.seal_codes(path, options, view(l), view(c));
            } else {
              const auto l = landmark_ids(ids);
              const auto d = descriptors(array, *self.encoder());
              const nb::gil_scoped_release release;
              self.seal(path, options, view(l), view(d));
            }
            const nb::gil_scoped_release release;
            return SealedMap(path);
          },
          "path"_a, "landmark_ids"_a = nb::none(), "descriptors"_a = nb::none(), nb::kw_only(),
          "bytes_per_landmark"_a = nb::none(), "position_bits"_a = 32, "tune"_a = true,
          "threads"_a = 1,
          nb::sig(
              "def seal(self, path: str | os.PathLike[str], landmark_ids: ArrayLike | None = "
              "None, descriptors: NDArray[numpy.uint8 | numpy.float32 | numpy.int8] | None = None, "
              "*, bytes_per_landmark: float | None = None, position_bits: int = 32, tune: bool = "
              "True, threads: int = "
              "1) -> SealedMap"),
          R"(Write a sealed map, whole or not at all, and open it.

Args:
    path: the file to write.
    landmark_ids: (n,), of descriptors.
    descriptors: as Encoder.encode takes them, or their codes, (n, dim) int8: the observations that
        the map was built from, as far as they are at hand. Prototypes are tuned by them, or else by the
        map's appearances if only one prototype per landmark fits.
    bytes_per_landmark: bytes that a landmark may take on average for its prototypes and their
        number (not for position, id and index). None: the sealed map gives the answers of
        this one: int8 numbers, every appearance (at most 255 per landmark). Otherwise prototypes
        are int8 numbers, too, if all of them fit; else words of one of the encoder's codebooks, and
        appearances are merged, over the whole map those first whose merging adds least to the
        squared distances of observations to their prototypes (Ward's criterion), until they fit.
        It takes the best words that fit, or, if no observations tune it, the best that leave room
        for 1.25 prototypes per landmark, from 48 numbers on.
    position_bits: bits per coordinate. With 32, positions are floats relative to the middle of the
        map; with 16 they take half the bytes, as steps of a grid over their bounding box, 65534
        from end to end along each axis (position_error); with 0 they are left out.
    tune: with bytes_per_landmark, whether prototypes are tuned against each other, so that a
        landmark is less often mistaken for another: a prototype is drawn to observations of its
        landmark that are near to others, and others are pushed off (learning vector quantization,
        Sato and Yamada 1996). Equal maps and observations give equal files.
    threads: CPU threads to tune on.

Raises:
    FileError: the file cannot be written, or the journal beside it is in use or holds commits,
        which would be lost.
    ValueError: bytes_per_landmark is less than the fewest words of a prototype take, or needs
        codebooks, which the encoder does not have; position_bits is not 32, 16 or 0; or positions
        are further than 3.4e38 from their middle.)");
}

}  // namespace

void bind_prototype_map(nb::module_& m) {
  nb::class_<PrototypeMap> map(
      m, "PrototypeMap",
      "A learning map: one prototype per landmark, or one per appearance of it, kept as an exact "
      "integer sum of codes, so that it follows every change without rounding.");
  map.def(
      "__init__",
      [](PrototypeMap* self, std::shared_ptr<Encoder> encoder, nb::object dim,
         std::size_t appearance_bits) {
        new (self) PrototypeMap(std::move(encoder), code_length(dim), appearance_bits);
      },
      "encoder"_a, "dim"_a.none() = nb::none(), "appearance_bits"_a = 0,
      nb::sig("def __init__(self, encoder: Encoder, dim: int | None = None, "
              "appearance_bits: int = 0) -> None"),
      R"(Make an empty map.

Args:
    encoder: makes codes of descriptors.
    dim: dimensions of a prototype, one of encoder.dims; None: all.
    appearance_bits: observations of a landmark whose codes differ in the sign of any of their first
        appearance_bits numbers are different appearances of it, and each appearance has a prototype
        of its own. 0 to 16 and at most dim; 0: one prototype per landmark.

Raises:
    ValueError: dim or appearance_bits is none of these.)");
  bind_answers(map);
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
    ValueError: "created" is no such time, or something is beyond the limits (docs/limits.md).)")
      .def_prop_ro("appearance_bits", &PrototypeMap::appearance_bits,
                   "Signs that tell the appearances of a landmark apart; 0: it has one prototype.")
      .def("counts", bind_of_landmarks<PrototypeMap>(&PrototypeMap::counts), "landmark_ids"_a,
           nb::sig("def counts(self, landmark_ids: ArrayLike) -> NDArray[numpy.uint32]"),
           "Numbers of observations, over all appearances, (n,) uint32. Raises KeyError for an id "
           "that is not in the map.")
      .def("appearance_counts", bind_of_landmark<PrototypeMap>(&PrototypeMap::appearance_counts),
           "landmark_id"_a,
           nb::sig("def appearance_counts(self, landmark_id: int) -> NDArray[numpy.uint32]"),
           "Number of observations of each of a landmark's appearances, (r,) uint32. Raises "
           "KeyError for an id that is not in the map.")
      .def("nprobe", &PrototypeMap::nprobe, "recall"_a, "threads"_a = 1, ReleaseGil(),
           "Number of inverted lists that a search with this recall, in (0, 1], visits, as "
           "measured on the map: prototypes are searched for among those of other landmarks, and "
           "codes as far from them as observations are among all (docs/large-maps.md). Measured "
           "once, "
           "and again when a tenth of the map has changed. Raises ValueError for another recall, "
           "and without an index.");
  bind_changes(map);
  bind_parts(map);
  bind_journal(map);
  map.def("__repr__", [](const PrototypeMap& self) {
    return "<protomark.PrototypeMap: " + describe_map(self) + ">";
  });
}

}  // namespace protomark::python
