"""FAISS: exact, graphs, inverted lists."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from protomark.bench.peers.index import Index, K, Search, doubling
from protomark.bench.peers.shelf import Shelf

_TRAINED_ON = 64  # rows a cell
_MANY = 65_536
_WHOLE = faiss.ScalarQuantizer.QT_8bit_direct_signed  # int8 as it is: nothing is lost
_M, _EF = 16, 200  # as hnswlib's own; FAISS's are 32 and 40


def flat(rows: NDArray[np.int8], queries: NDArray[np.int8]) -> Search:
    """IndexFlatL2, float32."""
    index = faiss.IndexFlatL2(rows.shape[1])
    index.add(rows.astype(np.float32))
    return _search(index, queries.astype(np.float32))


def binary_flat(rows: NDArray[np.uint8], queries: NDArray[np.uint8]) -> Search:
    """IndexBinaryFlat, Hamming distance of packed bits."""
    index = faiss.IndexBinaryFlat(8 * rows.shape[1])
    index.add(rows)
    return _search(index, queries)


def hnsw(
    rows: NDArray[np.int8],
    queries: NDArray[np.int8],
    threads: int,
    build_threads: int,
    *,
    shelf: Shelf,
) -> Index:
    """Graph over float32 rows."""

    def build() -> Any:
        index = faiss.IndexHNSWFlat(rows.shape[1], _M)
        index.hnsw.efConstruction = _EF
        _add(index, rows, build_threads, threads)
        return index

    index, seconds = shelf.built(f"HNSW {_M}, {_EF}", "faiss-cpu", rows, build, _write, _read)
    asked = queries.astype(np.float32)

    def prepare(ef: int) -> Search:
        index.hnsw.efSearch = ef
        return _search(index, asked)

    return Index(
        prepare,
        [doubling(8, 2048)],
        _bytes(index),
        "efSearch",
        f"M = {_M}, efConstruction = {_EF}",
        seconds=seconds,
    )


def scalar_quantizer(
    rows: NDArray[np.int8], queries: NDArray[np.int8], threads: int, build_threads: int
) -> Index:
    """Inverted lists of the rows as they are, 8 bits a dimension."""
    cells = _cells(len(rows))
    index = faiss.IndexIVFScalarQuantizer(
        faiss.IndexFlatL2(rows.shape[1]),
        rows.shape[1],
        cells,
        _WHOLE,
        faiss.METRIC_L2,
        False,  # no residuals, which are not int8
    )
    _add(index, rows, build_threads, threads)
    asked = queries.astype(np.float32)

    def prepare(probes: int) -> Search:
        index.nprobe = probes
        return _search(index, asked)

    return Index(prepare, [doubling(1, cells)], _bytes(index), "probes", f"{cells:,} cells")


def product_quantizer(
    rows: NDArray[np.int8],
    queries: NDArray[np.int8],
    threads: int,
    build_threads: int,
    *,
    parts: int,
) -> Index:
    """Inverted lists of 4-bit codes of each of so many parts (fast scan), refined by whole rows."""
    cells, dim = _cells(len(rows)), rows.shape[1]
    base = faiss.IndexIVFPQFastScan(faiss.IndexFlatL2(dim), dim, cells, parts, 4)
    refine = faiss.IndexScalarQuantizer(dim, _WHOLE, faiss.METRIC_L2)
    index = faiss.IndexRefine(base, refine)
    _add(index, rows, build_threads, threads)
    asked = queries.astype(np.float32)

    def prepare(setting: tuple[int, int]) -> Search:
        base.nprobe, index.k_factor = setting
        return _search(index, asked)

    # The most thorough first: once it has found enough, others are left where they take longer.
    lines = [[(probes, factor) for probes in doubling(1, cells)] for factor in (256, 64, 16, 4)]
    note = f"{cells:,} cells, PQ{parts}x4fs, refined by whole rows"
    return Index(prepare, lines, _bytes(base) + _bytes(refine), "probes and factor", note)


def many_cells(
    rows: NDArray[np.int8],
    queries: NDArray[np.int8],
    threads: int,
    build_threads: int,
    *,
    shelf: Shelf,
) -> Index:
    """65,536 lists, found by a graph, as FAISS's guide has it from a million rows on.

    Their centroids come from as many rows as FAISS takes without a warning, found by a graph
    there, too: a k-means that compares all with all takes an hour on two cores.
    """
    dim = rows.shape[1]

    def build() -> Any:
        coarse = faiss.IndexHNSWFlat(dim, 32)
        base = faiss.IndexIVFPQFastScan(coarse, dim, _MANY, dim, 4)
        base.quantizer_trains_alone = 2  # clusters first, then adds the centroids to the graph
        finder = faiss.IndexHNSWFlat(dim, 32)  # FAISS does not keep it alive
        base.clustering_index = finder
        index = faiss.IndexRefine(base, faiss.IndexScalarQuantizer(dim, _WHOLE, faiss.METRIC_L2))
        _add(index, rows, build_threads, threads, 39 * _MANY)
        base.clustering_index = None
        return index

    index, seconds = shelf.built(f"IVF {_MANY} HNSW 32", "faiss-cpu", rows, build, _write, _read)
    base = faiss.downcast_index(index.base_index)
    coarse = faiss.downcast_index(base.quantizer)
    asked = queries.astype(np.float32)

    def prepare(setting: tuple[int, int]) -> Search:
        base.nprobe, index.k_factor = setting
        coarse.hnsw.efSearch = base.nprobe
        return _search(index, asked)

    lines = [[(probes, factor) for probes in doubling(8, 2048)] for factor in (256, 64, 16, 4)]
    note = f"{_MANY:,} cells, found by a graph; PQ{dim}x4fs, refined by whole rows"
    return Index(prepare, lines, _bytes(index), "probes and factor", note, seconds=seconds)


def _search(index: Any, queries: NDArray[Any]) -> Search:
    def run(n: int) -> NDArray[np.int64]:
        found: NDArray[np.int64] = index.search(queries[:n], K)[1][:, 0]
        return found

    return run


def _add(
    index: Any,
    rows: NDArray[np.int8],
    build_threads: int,
    threads: int,
    trained_on: int | None = None,
) -> None:
    faiss.omp_set_num_threads(build_threads)
    try:
        if not index.is_trained:
            step = max(len(rows) // (trained_on or _TRAINED_ON * _cells(len(rows))), 1)
            index.train(rows[::step].astype(np.float32))
        for begin in range(0, len(rows), 1 << 20):
            index.add(rows[begin : begin + (1 << 20)].astype(np.float32))
    finally:
        faiss.omp_set_num_threads(threads)


def _write(index: Any, path: Path) -> None:
    faiss.write_index(index, str(path))


def _read(path: Path) -> Any:
    return faiss.read_index(str(path))


def _cells(n: int) -> int:
    """Four times the root, as FAISS's guide has it for up to a million rows."""
    return max(min(int(4 * sqrt(n)), n // _TRAINED_ON), 1)


def _bytes(index: Any) -> int:
    writer = _Counter()
    faiss.write_index(index, faiss.PyCallbackIOWriter(writer.write))
    return writer.size


class _Counter:
    """Counts bytes instead of keeping them."""

    size = 0

    def write(self, data: bytes) -> None:
        self.size += len(data)
