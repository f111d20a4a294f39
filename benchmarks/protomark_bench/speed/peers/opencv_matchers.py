"""OpenCV: the brute-force matcher and FLANN."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protomark_bench.speed.peers.index import IndexQueries, K, Search, TunableIndex, doubling

_PART = (1 << 18) - 1  # BFMatcher's limit on rows per piece
_KDTREE, _LSH = 1, 6


def brute_force(rows: NDArray[np.uint8], queries: NDArray[np.uint8]) -> Search:
    """BFMatcher with Hamming distance."""
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    matcher.add([rows[begin : begin + _PART] for begin in range(0, len(rows), _PART)])

    def run(n: int) -> NDArray[np.int64]:
        matches = matcher.knnMatch(queries[:n], k=K)
        return np.array([m[0].imgIdx * _PART + m[0].trainIdx for m in matches], np.int64)

    return run


def kd_trees(rows: NDArray[np.int8], asked: IndexQueries) -> TunableIndex:
    """FLANN's randomised kd-trees on float32 prototypes."""
    values = rows.astype(np.float32)
    index = cv2.flann.Index(values, {"algorithm": _KDTREE, "trees": 4})
    size = _bytes(index) + values.nbytes
    prepare = partial(_search, index, asked.floats)
    return TunableIndex(prepare, [doubling(32, 16384)], size, "checks", "4 trees")


def lsh(rows: NDArray[np.uint8], queries: NDArray[np.uint8]) -> TunableIndex:
    """FLANN's locality-sensitive hashing on bits.

    The setting is the number of bits of a key that may differ; each setting has its own index.
    """
    indexes = {
        level: cv2.flann.Index(
            rows,
            {"algorithm": _LSH, "table_number": 12, "key_size": 20, "multi_probe_level": level},
        )
        for level in range(3)
    }
    size = _bytes(indexes[2]) + rows.nbytes
    note = "12 tables, keys of 20 bits"

    def prepare(level: int) -> Search:
        return _search(indexes[level], queries, 32)

    return TunableIndex(prepare, [list(indexes)], size, "multi-probe level", note)


def _search(index: Any, queries: NDArray[Any], checks: int) -> Search:
    def run(n: int) -> NDArray[np.int64]:
        found, _ = index.knnSearch(queries[:n], K, params={"checks": checks})
        return found[:, 0].astype(np.int64)

    return run


def _bytes(index: Any) -> int:
    """Size of the saved index, without the rows."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "index"
        index.save(str(path))
        return path.stat().st_size
