"""hnswlib: a graph over float32 rows."""

from __future__ import annotations

from pathlib import Path

import hnswlib
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

_M, _EF = 16, 200  # the defaults


def hnsw(rows: NDArray[np.int8], asked: IndexQueries, *, cache: IndexCache) -> TunableIndex:
    """The graph, from the cache or new."""
    n, dim = rows.shape

    def build() -> hnswlib.Index:
        index = hnswlib.Index(space="l2", dim=dim)
        index.init_index(max_elements=n, M=_M, ef_construction=_EF, random_seed=0)
        for begin in range(0, n, 1 << 20):
            part = rows[begin : begin + (1 << 20)].astype(np.float32)
            index.add_items(part, None, asked.build_threads)
        return index

    def write(index: hnswlib.Index, path: Path) -> None:
        index.save_index(str(path))

    def read(path: Path) -> hnswlib.Index:
        index = hnswlib.Index(space="l2", dim=dim)
        index.load_index(str(path))
        return index

    index, seconds = cache.get(f"{_M}, {_EF}", "hnswlib", rows, build, write, read)

    def prepare(ef: int) -> Search:
        index.set_ef(ef)

        def run(n: int) -> NDArray[np.int64]:
            found, _ = index.knn_query(asked.floats[:n], k=K, num_threads=asked.threads)
            result: NDArray[np.int64] = found[:, 0].astype(np.int64)
            return result

        return run

    note = f"M = {_M}, efConstruction = {_EF}"
    size = index.index_file_size()
    return TunableIndex(prepare, [doubling(8, 2048)], size, "efSearch", note, seconds=seconds)
