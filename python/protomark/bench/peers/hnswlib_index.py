"""hnswlib: a graph over float32 rows."""

from __future__ import annotations

import hnswlib
import numpy as np
from numpy.typing import NDArray

from protomark.bench.peers.index import Index, K, Search, doubling


def hnsw(
    rows: NDArray[np.int8], queries: NDArray[np.int8], threads: int, build_threads: int
) -> Index:
    """M = 16, efConstruction = 200, both its defaults."""
    index = hnswlib.Index(space="l2", dim=rows.shape[1])
    index.init_index(max_elements=len(rows), M=16, ef_construction=200, random_seed=0)
    for begin in range(0, len(rows), 1 << 20):
        index.add_items(rows[begin : begin + (1 << 20)].astype(np.float32), None, build_threads)
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
        "M = 16, efConstruction = 200",
    )
