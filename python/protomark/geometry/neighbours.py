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


def cube_numbers(cubes: NDArray[np.floating]) -> NDArray[np.int64]:
    """A number (n,) for each cube (n, 3) of whole numbers; hardly ever do two cubes share one."""
    whole = np.clip(cubes, -(2.0**60), 2.0**60).astype(np.int64)
    return np.asarray(
        whole @ np.array([0x5D588B656C078965, 0x27BB2EE687B0B0FD, 0x369DEA0F31A53F85])
    )


def near_points(
    first: NDArray[np.float64], second: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs (i, j) for which first[i] and second[j], (n, 3) and (m, 3), are within a radius."""
    first, second = first / (2 * radius), second / (2 * radius)
    cell = cube_numbers(np.floor(second))
    order = np.argsort(cell)
    cell = cell[order]
    # A ball reaches into the nearer of the two neighbouring cubes along each axis.
    corner = np.floor(first - 0.5)
    found = []
    for offset in np.ndindex(2, 2, 2):
        near = cube_numbers(corner + offset)
        rows = np.argsort(near)  # a search for sorted numbers is many times faster
        start = np.searchsorted(cell, near[rows], side="left")
        count = np.searchsorted(cell, near[rows], side="right") - start
        i = np.repeat(rows, count)
        j = order[np.arange(len(i)) + np.repeat(start - np.cumsum(count) + count, count)]
        close = ((first[i] - second[j]) ** 2).sum(axis=1) <= 0.25
        found.append((i[close], j[close]))
    i, j = (np.concatenate(part) for part in zip(*found, strict=True))
    return i, j
