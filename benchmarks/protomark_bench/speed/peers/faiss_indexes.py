"""FAISS: exact search, graphs and inverted lists."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from protomark_bench.speed.peers.index import (
    IndexCache,
    IndexQueries,
    K,
    Search,
    TunableIndex,
    doubling,
)

_TRAINING_ROWS = 64  # per inverted list
_GRAPH_LISTS = 65_536
_GRAPH_TRAINING_ROWS = 39  # per list, as many as FAISS takes without a warning
_SQ8 = faiss.ScalarQuantizer.QT_8bit_direct_signed  # int8 without loss
_M, _EF = 16, 200  # hnswlib's defaults; FAISS's are 32 and 40


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


def hnsw(rows: NDArray[np.int8], asked: IndexQueries, *, cache: IndexCache) -> TunableIndex:
    """A graph over float32 rows."""

    def build() -> Any:
        index = faiss.IndexHNSWFlat(rows.shape[1], _M)
        index.hnsw.efConstruction = _EF
        _add(index, rows, asked)
        return index

    index, seconds = _cached(cache, f"HNSW {_M}, {_EF}", rows, build)

    def prepare(ef: int) -> Search:
        index.hnsw.efSearch = ef
        return _search(index, asked.floats)

    note = f"M = {_M}, efConstruction = {_EF}"
    lines = [doubling(8, 2048)]
    return TunableIndex(prepare, lines, _bytes(index), "efSearch", note, seconds=seconds)


def scalar_quantizer(rows: NDArray[np.int8], asked: IndexQueries) -> TunableIndex:
    """Inverted lists of the int8 rows, 8 bits per dimension."""
    nlist, dim = _nlist(len(rows)), rows.shape[1]
    quantizer = faiss.IndexFlatL2(dim)
    by_residual = False  # residuals are not int8
    index = faiss.IndexIVFScalarQuantizer(quantizer, dim, nlist, _SQ8, faiss.METRIC_L2, by_residual)
    _add(index, rows, asked)

    def prepare(nprobe: int) -> Search:
        index.nprobe = nprobe
        return _search(index, asked.floats)

    return TunableIndex(prepare, nlist, _bytes(index), "nprobe", f"nlist {nlist:,}")


def product_quantizer(rows: NDArray[np.int8], asked: IndexQueries, *, parts: int) -> TunableIndex:
    """Inverted lists of 4-bit codes of these parts (fast scan), refined by whole rows."""
    nlist, dim = _nlist(len(rows)), rows.shape[1]
    base = faiss.IndexIVFPQFastScan(faiss.IndexFlatL2(dim), dim, nlist, parts, 4)
    refine = faiss.IndexScalarQuantizer(dim, _SQ8, faiss.METRIC_L2)
    index = faiss.IndexRefine(base, refine)
    _add(index, rows, asked)

    def prepare(setting: tuple[int, int]) -> Search:
        base.nprobe, index.k_factor = setting
        return _search(index, asked.floats)

    note = f"nlist {nlist:,}, PQ{parts}x4fs, refined by whole rows"
    size = _bytes(base) + _bytes(refine)
    return TunableIndex(prepare, _refined(1, nlist), size, "nprobe and k_factor", note)


def lists_by_graph(
    rows: NDArray[np.int8], asked: IndexQueries, *, cache: IndexCache
) -> TunableIndex:
    """65,536 lists that a graph finds, as FAISS's guide recommends from a million rows on.

    Clustering finds centroids by a graph, too, as an exhaustive k-means takes an hour on two cores.
    """
    dim = rows.shape[1]

    def build() -> Any:
        coarse = faiss.IndexHNSWFlat(dim, 32)
        base = faiss.IndexIVFPQFastScan(coarse, dim, _GRAPH_LISTS, dim, 4)
        base.quantizer_trains_alone = 2  # cluster first, then add the centroids to the graph
        finder = faiss.IndexHNSWFlat(dim, 32)  # FAISS does not keep it alive
        base.clustering_index = finder
        index = faiss.IndexRefine(base, faiss.IndexScalarQuantizer(dim, _SQ8, faiss.METRIC_L2))
        _add(index, rows, asked, _GRAPH_TRAINING_ROWS * _GRAPH_LISTS)
        base.clustering_index = None
        return index

    index, seconds = _cached(cache, f"IVF {_GRAPH_LISTS} HNSW 32", rows, build)
    base = faiss.downcast_index(index.base_index)
    coarse = faiss.downcast_index(base.quantizer)

    def prepare(setting: tuple[int, int]) -> Search:
        base.nprobe, index.k_factor = setting
        coarse.hnsw.efSearch = base.nprobe
        return _search(index, asked.floats)

    note = f"nlist {_GRAPH_LISTS:,}, found by a graph; PQ{dim}x4fs, refined by whole rows"
    lines, size = _refined(8, 2048), _bytes(index)
    return TunableIndex(prepare, lines, size, "nprobe and k_factor", note, seconds=seconds)


def _refined(first: int, last: int) -> list[list[tuple[int, int]]]:
    """Lines of (nprobe, k_factor).

    The most thorough line comes first: once it reaches the goal, slower settings of the others are
    skipped.
    """
    return [[(nprobe, factor) for nprobe in doubling(first, last)] for factor in (256, 64, 16, 4)]


def _search(index: Any, queries: NDArray[Any]) -> Search:
    def run(n: int) -> NDArray[np.int64]:
        found: NDArray[np.int64] = index.search(queries[:n], K)[1][:, 0]
        return found

    return run


def _add(index: Any, rows: NDArray[np.int8], asked: IndexQueries, training_rows: int = 0) -> None:
    training_rows = training_rows or _TRAINING_ROWS * _nlist(len(rows))
    faiss.omp_set_num_threads(asked.build_threads)
    try:
        if not index.is_trained:
            step = max(len(rows) // training_rows, 1)
            index.train(rows[::step].astype(np.float32))
        for begin in range(0, len(rows), 1 << 20):
            index.add(rows[begin : begin + (1 << 20)].astype(np.float32))
    finally:
        faiss.omp_set_num_threads(asked.threads)


def _cached(
    cache: IndexCache, label: str, rows: NDArray[np.int8], build: Callable[[], Any]
) -> tuple[Any, float]:
    def write(index: Any, path: Path) -> None:
        faiss.write_index(index, str(path))

    def read(path: Path) -> Any:
        return faiss.read_index(str(path))

    return cache.get(label, "faiss-cpu", rows, build, write, read)


def _nlist(n: int) -> int:
    """Four times the root, as FAISS's guide recommends up to a million rows."""
    return max(min(int(4 * sqrt(n)), n // _TRAINING_ROWS), 1)


def _bytes(index: Any) -> int:
    size = 0

    def count(data: bytes) -> None:
        nonlocal size
        size += len(data)

    faiss.write_index(index, faiss.PyCallbackIOWriter(count))
    return size
