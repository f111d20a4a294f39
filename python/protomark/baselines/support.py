"""The observations that a map is built from, grouped by landmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import InputKind, numbers_of

# Numbers of descriptors are handled in pieces of about this many rows, to bound the memory.
_CHUNK = 1 << 15


class Support:
    """Descriptors grouped by landmark; derived sums and means are computed once, on first use.

    Attributes:
        descriptors: (n, b), sorted by landmark, else in their given order.
        landmarks: (n,) int64, the landmark of each row.
        ids: (l,) int64, the distinct landmarks, ascending.
        starts: (l,) int64, the first row of each landmark.
        counts: (l,) int64, observations of each landmark.
        seed: seed of methods that draw at random.
        kind: what the descriptors are.
    """

    def __init__(
        self,
        landmarks: NDArray[np.int64],
        descriptors: NDArray[Any],
        seed: int = 0,
        kind: InputKind = "bits",
    ) -> None:
        if not len(landmarks):
            raise ValueError("there are no observations to build a map from: give longer tracks")
        if descriptors.ndim != 2 or len(descriptors) != len(landmarks):
            raise ValueError(
                f"descriptors have shape {descriptors.shape}, expected ({len(landmarks)}, bytes)"
            )
        order = np.argsort(landmarks, kind="stable")
        self.landmarks = landmarks[order]
        self.descriptors = np.ascontiguousarray(descriptors[order])
        self.ids, self.starts, self.counts = np.unique(
            self.landmarks, return_index=True, return_counts=True
        )
        self.seed = seed
        self.kind = kind

    @property
    def width(self) -> int:
        """How many numbers a descriptor has: bits, or those of a vector."""
        return int(self.descriptors.shape[1]) * (8 if self.kind == "bits" else 1)

    def pieces(self, rows: int = _CHUNK) -> Iterator[tuple[int, int]]:
        """Ranges of whole landmarks with about `rows` observations each."""
        first, ends = 0, self.starts + self.counts
        while first < len(self.ids):
            last = int(np.searchsorted(ends, self.starts[first] + rows, side="right"))
            last = max(last, first + 1)
            yield first, last
            first = last

    @cached_property
    def sums(self) -> NDArray[Any]:
        """(l, width) sums of the numbers of each landmark's descriptors, int32, or of floats."""
        dtype = np.float64 if self.kind == "float32" else np.int32
        sums = np.empty((len(self.ids), self.width), dtype=dtype)
        for first, last in self.pieces():
            start, end = self.starts[first], self.starts[last - 1] + self.counts[last - 1]
            numbers = numbers_of(self.descriptors[start:end], self.kind)
            np.add.reduceat(
                numbers, self.starts[first:last] - start, axis=0, dtype=dtype, out=sums[first:last]
            )
        return sums

    @cached_property
    def means(self) -> NDArray[np.float32]:
        """(l, width) float32, the mean of each landmark's descriptors."""
        return (self.sums / self.counts[:, None]).astype(np.float32)

    @cached_property
    def moments(self) -> Moments:
        """Moments of the numbers over at most `Moments.MAX_ROWS` of these observations."""
        return Moments.of(self)


@dataclass(frozen=True, eq=False)
class Moments:
    """Mean and covariances of descriptors' numbers, from which linear projections are learned."""

    # Far fewer rows than this estimate a quarter of a million numbers well.
    MAX_ROWS: ClassVar = 100_000

    mean: NDArray[np.float64]  # (width,) float64
    total: NDArray[np.float64]  # (width, width) float64, covariance over all observations
    # (width, width) float64, pooled covariance of observations of one landmark.
    within: NDArray[np.float64]

    @classmethod
    def of(cls, support: Support) -> Moments:
        """Moments over landmarks that are drawn at random until they have enough observations."""
        rng = np.random.default_rng(support.seed)
        drawn = rng.permutation(len(support.ids))
        count = int(np.searchsorted(np.cumsum(support.counts[drawn]), cls.MAX_ROWS)) + 1
        chosen = np.zeros(len(support.ids), dtype=bool)
        chosen[drawn[:count]] = True
        rows = np.flatnonzero(np.repeat(chosen, support.counts))
        # A piece sums fewer than 2^24 products of 0 and 1, which is exact in float32.
        dtype: Any = np.float32 if support.kind == "bits" else np.float64
        sums = support.sums[chosen].astype(dtype)
        counts = support.counts[chosen]
        second = np.zeros((support.width, support.width))
        for at in range(0, len(rows), _CHUNK):
            part = support.descriptors[rows[at : at + _CHUNK]]
            numbers = numbers_of(part, support.kind).astype(dtype)
            second += numbers.T @ numbers
        between = np.zeros_like(second)
        for at in range(0, len(sums), _CHUNK):
            scaled = sums[at : at + _CHUNK] / np.sqrt(counts[at : at + _CHUNK, None])
            scaled = scaled.astype(dtype)
            between += scaled.T @ scaled
        mean = sums.sum(axis=0, dtype=np.float64) / len(rows)
        total = second / len(rows) - np.outer(mean, mean)
        within = (second - between) / max(len(rows) - len(counts), 1)
        return cls(mean, total, within)
