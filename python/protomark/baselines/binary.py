"""Baselines that keep descriptors: one or more per landmark, searched by their own distance.

That is Hamming distance for bits, and Euclidean distance for vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark._core import hamming_search
from protomark.baselines.linear import EuclideanMap
from protomark.baselines.method import Method
from protomark.baselines.support import Support
from protomark.features.descriptors import InputKind, numbers_of

# Medoids of landmarks with the same number of observations are computed together, up to this many
# numbers at a time.
_NUMBERS = 1 << 24


@dataclass(eq=False)
class DescriptorMap(Method):
    """Descriptors of landmarks, sorted by landmark id."""

    descriptors: NDArray[Any]
    landmarks: NDArray[np.int64]
    bytes_per_landmark: float
    kind: InputKind = "bits"

    def match(
        self, descriptors: NDArray[Any], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        if self.kind != "bits":
            return self._vectors.match(descriptors, threads)
        landmarks, distances = hamming_search(
            descriptors, self.descriptors, k=2, landmarks=self.landmarks, threads=threads
        )
        return landmarks, np.where(landmarks >= 0, distances, np.inf).astype(np.float32)

    @cached_property
    def _vectors(self) -> EuclideanMap:
        return EuclideanMap(self.descriptors, self.landmarks, self.bytes_per_landmark, self.kind)


def unaggregated(support: Support) -> DescriptorMap:
    """Every descriptor, and one byte per landmark for their number.

    With the number of its descriptors, a landmark is found from any of them.
    """
    observations = len(support.descriptors) / len(support.ids)
    size = observations * support.descriptors[0].nbytes + 1
    return DescriptorMap(support.descriptors, support.landmarks, size, support.kind)


def first_seen(support: Support) -> DescriptorMap:
    """The descriptor of the earliest keyframe."""
    return _one_each(support, support.descriptors[support.starts])


def random_sample(support: Support) -> DescriptorMap:
    """A descriptor drawn at random."""
    rng = np.random.default_rng(support.seed)
    rows = support.starts + rng.integers(0, support.counts)
    return _one_each(support, support.descriptors[rows])


def majority(support: Support) -> DescriptorMap:
    """The mean of each bit, quantised at 0.5: a bit that half of the descriptors set is set.

    The mean of vectors of bytes is rounded to bytes.

    Other rules for ties (clear, as in the first descriptor, at random) change the precision by
    less than its spread over seeds.
    """
    if support.kind != "bits":
        mean = support.means if support.kind == "float32" else np.rint(support.means)
        return _one_each(support, mean.astype(support.descriptors.dtype))
    bits = 2 * support.sums >= support.counts[:, None]
    return _one_each(support, np.packbits(bits, axis=1, bitorder="little"))


def bitwise_and(support: Support) -> DescriptorMap:
    """The bits that all of a landmark's descriptors set, which vectors do not have."""
    return _one_each(support, np.bitwise_and.reduceat(support.descriptors, support.starts, axis=0))


def medoid(support: Support) -> DescriptorMap:
    """The descriptor that ORB-SLAM (Mur-Artal et al. 2015) and stella_vslam keep of a landmark.

    It has the least median distance to all of the landmark's descriptors, itself included
    (of two middle values the lower one counts); ties go to the first descriptor. This is
    `MapPoint::ComputeDistinctiveDescriptors` of ORB-SLAM.
    """
    chosen = support.starts.copy()
    for size in np.unique(support.counts):
        same = np.flatnonzero(support.counts == size)
        step = max(1, _NUMBERS // (int(size) * support.width))
        for start in range(0, len(same), step):
            chunk = same[start : start + step]
            rows = support.starts[chunk][:, None] + np.arange(size)
            chosen[chunk] += _least_median(support, rows)
    return _one_each(support, support.descriptors[chosen])


def _least_median(support: Support, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index (g,) of the descriptor with the least median distance in each group of rows (g, n)."""
    size = rows.shape[1]
    numbers = numbers_of(support.descriptors[rows.ravel()], support.kind)
    x = numbers.astype(np.float32).reshape(*rows.shape, -1)
    # Squares of bits and bytes have sums below 2^24, which are exact in float32.
    norms = np.square(x).sum(axis=2)
    distances = norms[:, :, None] + norms[:, None, :] - 2 * x @ x.transpose(0, 2, 1)
    middle = (size - 1) // 2
    medians = np.partition(distances, middle, axis=2)[:, :, middle]
    return np.argmin(medians, axis=1)


def _one_each(support: Support, descriptors: NDArray[Any]) -> DescriptorMap:
    return DescriptorMap(descriptors, support.ids, descriptors[0].nbytes, support.kind)
