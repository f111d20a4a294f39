"""Distances between descriptors: Hamming of bits, Euclidean of numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark._core import hamming_search
from protomark.features.descriptors import InputKind

_POPCOUNT = np.array([bin(i).count("1") for i in range(256)], np.uint8)
_CHUNK = 4096  # queries


def nearest(
    queries: NDArray[Any], rows: NDArray[Any], k: int, kind: InputKind
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The k nearest of at least k rows (r, b) of each query (q, b), of equals the first.

    Returns:
        (q, k) int64 indices, and (q, k) float32 distances.
    """
    if kind == "bits":
        index, bits = hamming_search(queries, rows, k=k)
        return index, bits.astype(np.float32)
    index = np.empty((len(queries), k), np.int64)
    squares = np.empty((len(queries), k), np.float32)
    # Products of bytes, and their sums, are whole numbers that float32 has, in any order.
    columns = rows.astype(np.float32).T
    norms = (columns * columns).sum(0)
    for start in range(0, len(queries), _CHUNK):
        part = queries[start : start + _CHUNK].astype(np.float32)
        off = part @ (-2 * columns) + norms
        each = np.arange(len(part))
        for i in range(k):
            best = off.argmin(1)
            index[start : start + _CHUNK, i] = best
            squares[start : start + _CHUNK, i] = off[each, best] + (part * part).sum(1)
            off[each, best] = np.inf
    return index, np.sqrt(np.maximum(squares, 0))


def distances(first: NDArray[Any], second: NDArray[Any], kind: InputKind) -> NDArray[np.float32]:
    """Distances (n,) of each of the rows (n, b) from that of the other array."""
    if kind == "bits":
        return _POPCOUNT[first ^ second].sum(1, dtype=np.float32)
    off = first.astype(np.float32) - second
    return np.asarray(np.sqrt((off * off).sum(1)))
