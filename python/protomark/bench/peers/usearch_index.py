"""USearch: graphs over int8 and over float32 rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from usearch.index import Index as Graph

from protomark.bench.peers.index import Index, K, Search, doubling
from protomark.bench.peers.shelf import Shelf

_CONNECTIVITY, _EXPANSION = 16, 200  # as thorough as the other graphs; its own default is 128


def hnsw(
    rows: NDArray[np.int8],
    queries: NDArray[np.int8],
    threads: int,
    build_threads: int,
    *,
    dtype: str,
    shelf: Shelf,
) -> Index:
    """Rows as they are, or as float32."""
    asked: NDArray[Any] = queries if dtype == "i8" else queries.astype(np.float32)

    def build() -> Graph:
        index = Graph(
            ndim=rows.shape[1],
            metric="l2sq",
            dtype=dtype,
            connectivity=_CONNECTIVITY,
            expansion_add=_EXPANSION,
        )
        index.add(
            np.arange(len(rows), dtype=np.uint64),
            rows if dtype == "i8" else rows.astype(np.float32),
            threads=build_threads,
        )
        return index

    index, seconds = shelf.built(
        f"{dtype}, {_CONNECTIVITY}, {_EXPANSION}",
        "usearch",
        rows,
        build,
        lambda index, path: index.save(str(path)),
        _read,
    )

    def prepare(ef: int) -> Search:
        index.expansion_search = ef

        def run(n: int) -> NDArray[np.int64]:
            keys = np.asarray(index.search(asked[:n], K, threads=threads).keys)
            return keys.reshape(n, K)[:, 0].astype(np.int64)

        return run

    return Index(
        prepare,
        [doubling(8, 2048)],
        int(index.serialized_length),
        "expansion_search",
        f"connectivity = {_CONNECTIVITY}, expansion_add = {_EXPANSION}",
        seconds=seconds,
    )


def _read(path: Path) -> Graph:
    index = Graph.restore(str(path))
    if index is None:
        raise OSError(f"{path}: no index of USearch")
    return index
