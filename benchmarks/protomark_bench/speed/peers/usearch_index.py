"""USearch: graphs over int8 and over float32 rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from usearch.index import Index as Graph

from protomark_bench.speed.peers.index import (
    IndexCache,
    IndexQueries,
    K,
    Search,
    TunableIndex,
    doubling,
)

_CONNECTIVITY, _EXPANSION = 16, 200  # as in the other graphs; the default expansion is 128


def hnsw(
    rows: NDArray[np.int8], asked: IndexQueries, *, dtype: str, cache: IndexCache
) -> TunableIndex:
    """The graph over the rows as int8 ("i8") or float32 ("f32")."""
    queries: NDArray[Any] = asked.codes if dtype == "i8" else asked.floats

    def build() -> Graph:
        index = Graph(
            ndim=rows.shape[1],
            metric="l2sq",
            dtype=dtype,
            connectivity=_CONNECTIVITY,
            expansion_add=_EXPANSION,
        )
        values = rows if dtype == "i8" else rows.astype(np.float32)
        keys = np.arange(len(rows), dtype=np.uint64)
        index.add(keys, values, threads=asked.build_threads)
        return index

    def write(index: Graph, path: Path) -> None:
        index.save(str(path))

    def read(path: Path) -> Graph:
        index = Graph.restore(str(path))
        if index is None:
            raise OSError(f"{path}: not an index of USearch, delete it")
        return index

    label = f"{dtype}, {_CONNECTIVITY}, {_EXPANSION}"
    index, seconds = cache.get(label, "usearch", rows, build, write, read)

    def prepare(ef: int) -> Search:
        index.expansion_search = ef

        def run(n: int) -> NDArray[np.int64]:
            keys = np.asarray(index.search(queries[:n], K, threads=asked.threads).keys)
            return keys.reshape(n, K)[:, 0].astype(np.int64)

        return run

    note = f"connectivity = {_CONNECTIVITY}, expansion_add = {_EXPANSION}"
    lines, size = [doubling(8, 2048)], int(index.serialized_length)
    return TunableIndex(prepare, lines, size, "expansion_search", note, seconds=seconds)
