"""Finds points of two sets that are near each other in the image, and runs of equal numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def near_pairs(
    first: NDArray[np.float64], second: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs (i, j), sorted, for which first[i] and second[j] are at most `radius` apart.

    Args:
        first: (n, 2) pixels.
        second: (m, 2) pixels.
        radius: pixels.
    """
    empty = np.zeros(0, np.int64)
    if not len(first) or not len(second):
        return empty, empty
    # Five by five cells of half the radius cover less than three by three cells of the radius.
    low = np.minimum(first.min(0), second.min(0))
    a, b = (np.floor((p - low) * (2 / radius)).astype(np.int64) + 2 for p in (first, second))
    columns = int(max(a[:, 0].max(), b[:, 0].max())) + 4
    cell = b[:, 1] * columns + b[:, 0]
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    # Five neighbouring cells of a row have consecutive numbers.
    middle = ((a[:, 1, None] + np.arange(-2, 3)) * columns + a[:, 0, None]).ravel()
    start = np.searchsorted(cell, middle - 2, side="left")
    count = np.searchsorted(cell, middle + 2, side="right") - start
    i = np.repeat(np.repeat(np.arange(len(first)), 5), count)
    j = order[np.arange(len(i)) + np.repeat(start - np.cumsum(count) + count, count)]
    (x, y), (u, v) = first.T, second.T
    close = (x[i] - u[j]) ** 2 + (y[i] - v[j]) ** 2 <= radius * radius
    # Sorting by one combined key is many times faster than by two keys.
    pairs = np.sort(i[close] * len(second) + j[close])
    i = pairs // len(second)
    return i, pairs - i * len(second)


def runs(values: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and length of each run of equal entries in a sorted array."""
    changes = np.concatenate([[True], values[1:] != values[:-1]])
    starts = np.flatnonzero(changes[: len(values)])
    return starts, np.diff(np.append(starts, len(values)))
