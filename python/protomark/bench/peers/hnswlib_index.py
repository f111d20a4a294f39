"""hnswlib: a graph over float32 rows."""

from __future__ import annotations

from pathlib import Path

import hnswlib
import numpy as np
from numpy.typing import NDArray

from protomark.bench.peers.index import Index, K, Search, doubling
from protomark.bench.peers.shelf import Shelf

_M, _EF = 16, 200  # its defaults


def hnsw(
    rows: NDArray[np.int8],
    queries: NDArray[np.int8],
    threads: int,
    build_threads: int,
    *,
    shelf: Shelf,
) -> Index:
    """The graph, kept on the shelf."""
    n, dim = rows.shape

    def build() -> hnswlib.Index:
        index = hnswlib.Index(space="l2", dim=dim)
        index.init_index(max_elements=n, M=_M, ef_construction=_EF, random_seed=0)
        for begin in range(0, n, 1 << 20):
            index.add_items(rows[begin : begin + (1 << 20)].astype(np.float32), None, build_threads)
        return index

    def write(index: hnswlib.Index, path: Path) -> None:
        index.save_index(str(path))

    def read(path: Path) -> hnswlib.Index:
        index = hnswlib.Index(space="l2", dim=dim)
        index.load_index(str(path))
        return index

    index, seconds = shelf.built(f"{_M}, {_EF}", "hnswlib", rows, build, write, read)
    asked = queries.astype(np.float32)

    def prepare(ef: int) -> Search:
        index.set_ef(ef)

        def run(n: int) -> NDArray[np.int64]:
            found: NDArray[np.uint64] = index.knn_query(asked[:n], k=K, num_threads=threads)[0]
            return found[:, 0].astype(np.int64)

        return run

    return Index(
        prepare,
        [doubling(8, 2048)],
        index.index_file_size(),
        "efSearch",
        f"M = {_M}, efConstruction = {_EF}",
        seconds=seconds,
    )
