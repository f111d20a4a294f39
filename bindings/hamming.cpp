// Hamming search.
#include "protomark/hamming.h"
#include "module.h"

namespace protomark::python {
namespace {

Array2<std::uint8_t> binary(nb::handle object) {
  return array_of<Array2<std::uint8_t>>(object, "uint8", 2, "descriptors: a (n, bits / 8) uint8");
}

}  // namespace

void bind_hamming(nb::module_& m) {
  m.def(
      "hamming_search",
      [](nb::object queries, nb::object database, nb::object k, std::optional<nb::object> landmarks,
         std::optional<int> max_distance, nb::object threads) {
        const auto q = binary(queries);
        const auto d = binary(database);
        std::optional<Array1<std::int64_t>> ids;
        const auto count = integer<std::size_t>(k, "k");
        HammingOptions options{std::nullopt, max_distance, integer<int>(threads, "threads")};
        if (landmarks) options.landmarks = view(ids.emplace(landmark_ids(*landmarks)));
        return to_numpy(
            without_gil([&] { return hamming_search(view(q), view(d), count, options); }));
      },
      "queries"_a.none(), "database"_a.none(), "k"_a.none() = 2, "landmarks"_a = nb::none(),
      "max_distance"_a = nb::none(), "threads"_a.none() = 1,
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
    max_distance: the largest distance, in bits, at which a neighbour is reported.
    threads: threads to use.

Returns:
    Rows of database, or landmark ids, (q, k) int64, nearest first, ties to the smaller, -1 where
    there is none; and distances in bits (q, k) int32, 2^31 - 1 where there is none.

Raises:
    TypeError: queries or database are not (rows, bits / 8) uint8.
    ValueError: queries and database are of different sizes, landmarks does not have an id for each
        row, k or threads is below 1, or max_distance is negative.)");
  m.def("instruction_set", &instruction_set,
        "The instruction set in use, for example avx512; the environment variable PROTOMARK_ISA "
        "chooses another one. All give the same bytes.");
}

}  // namespace protomark::python
