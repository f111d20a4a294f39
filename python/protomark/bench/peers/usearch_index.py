"""USearch: graphs over int8 and over float32 rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from usearch.index import Index as Graph

from protomark.bench.peers.index import Index, K, Search, doubling


def hnsw_i8(
    rows: NDArray[np.int8], queries: NDArray[np.int8], threads: int, build_threads: int
) -> Index:
    """Rows as they are."""
    return _hnsw(rows, queries, threads, build_threads, "i8")


def hnsw_f32(
    rows: NDArray[np.int8], queries: NDArray[np.int8], threads: int, build_threads: int
) -> Index:
    """Rows as float32."""
    return _hnsw(rows.astype(np.float32), queries.astype(np.float32), threads, build_threads, "f32")


def _hnsw(
    rows: NDArray[Any], queries: NDArray[Any], threads: int, build_threads: int, dtype: str
) -> Index:
    # As thorough as the other graphs; USearch's own default is 128.
    index = Graph(
        ndim=rows.shape[1], metric="l2sq", dtype=dtype, connectivity=16, expansion_add=200
    )
    index.add(np.arange(len(rows), dtype=np.uint64), rows, threads=build_threads)

    def prepare(ef: int) -> Search:
        index.expansion_search = ef

        def run(n: int) -> NDArray[np.int64]:
            keys = np.asarray(index.search(queries[:n], K, threads=threads).keys)
            return keys.reshape(n, K)[:, 0].astype(np.int64)

        return run

    return Index(
        prepare,
        [doubling(8, 2048)],
        int(index.serialized_length),
        "expansion_search",
        "connectivity = 16, expansion_add = 200",
    )
