"""The observations that a map is built from, grouped by landmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import unpack_bits

# Unpacked bits are handled in pieces of about this many rows, to bound the memory.
_CHUNK = 1 << 15


class Support:
    """Descriptors grouped by landmark; derived sums and means are computed once, on first use.

    Attributes:
        descriptors: (n, bits / 8) uint8, sorted by landmark, else in their given order.
        landmarks: (n,) int64, the landmark of each row.
        ids: (l,) int64, the distinct landmarks, ascending.
        starts: (l,) int64, the first row of each landmark.
        counts: (l,) int64, observations of each landmark.
        seed: seed of methods that draw at random.
    """

    def __init__(
        self, landmarks: NDArray[np.int64], descriptors: NDArray[np.uint8], seed: int = 0
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

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * int(self.descriptors.shape[1])

    def pieces(self, rows: int = _CHUNK) -> Iterator[tuple[int, int]]:
        """Ranges of whole landmarks with about `rows` observations each."""
        first, ends = 0, self.starts + self.counts
        while first < len(self.ids):
            last = int(np.searchsorted(ends, self.starts[first] + rows, side="right"))
            last = max(last, first + 1)
            yield first, last
            first = last

    @cached_property
    def bit_sums(self) -> NDArray[np.int32]:
        """(l, bits) int32, number of each landmark's observations that set each bit."""
        sums = np.empty((len(self.ids), self.bits), dtype=np.int32)
        for first, last in self.pieces():
            start, end = self.starts[first], self.starts[last - 1] + self.counts[last - 1]
            bits = unpack_bits(self.descriptors[start:end])
            np.add.reduceat(
                bits, self.starts[first:last] - start, axis=0, dtype=np.int32, out=sums[first:last]
            )
        return sums

    @cached_property
    def means(self) -> NDArray[np.float32]:
        """(l, bits) float32, the mean of each landmark's bits."""
        return (self.bit_sums / self.counts[:, None]).astype(np.float32)

    @cached_property
    def moments(self) -> Moments:
        """Moments of the bits over at most `Moments.MAX_ROWS` of these observations."""
        return Moments.of(self)


@dataclass(frozen=True, eq=False)
class Moments:
    """Mean and covariances of descriptor bits, from which linear projections are learned."""

    # Far fewer rows than this estimate a quarter of a million numbers well.
    MAX_ROWS: ClassVar = 100_000

    mean: NDArray[np.float64]  # (bits,) float64
    total: NDArray[np.float64]  # (bits, bits) float64, covariance over all observations
    # (bits, bits) float64, pooled covariance of observations of one landmark.
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
        sums = support.bit_sums[chosen].astype(np.float32)
        counts = support.counts[chosen]

        # A piece sums fewer than 2^24 products of 0 and 1, which is exact in float32.
        second = np.zeros((support.bits, support.bits))
        for at in range(0, len(rows), _CHUNK):
            bits = unpack_bits(support.descriptors[rows[at : at + _CHUNK]]).astype(np.float32)
            second += bits.T @ bits
        between = np.zeros_like(second)
        for at in range(0, len(sums), _CHUNK):
            scaled = sums[at : at + _CHUNK] / np.sqrt(counts[at : at + _CHUNK, None])
            scaled = scaled.astype(np.float32)
            between += scaled.T @ scaled
        mean = sums.sum(axis=0, dtype=np.float64) / len(rows)
        total = second / len(rows) - np.outer(mean, mean)
        within = (second - between) / max(len(rows) - len(counts), 1)
        return cls(mean, total, within)
