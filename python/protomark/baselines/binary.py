"""Binary baselines: one or more packed descriptors per landmark, searched by Hamming distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark._core import hamming_search
from protomark.baselines.method import Method
from protomark.baselines.support import Support
from protomark.features.descriptors import unpack_bits

# Medoids of landmarks with the same number of observations are computed together, up to this many
# bits at a time.
_BITS = 1 << 24


@dataclass(eq=False)
class HammingMap(Method):
    """Descriptors of landmarks, sorted by landmark id."""

    descriptors: NDArray[np.uint8]
    landmarks: NDArray[np.int64]
    bytes_per_landmark: float

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        landmarks, distances = hamming_search(
            descriptors, self.descriptors, k=2, landmarks=self.landmarks, threads=threads
        )
        return landmarks, np.where(landmarks >= 0, distances, np.inf).astype(np.float32)


def unaggregated(support: Support) -> HammingMap:
    """Every descriptor, and one byte per landmark for their number.

    With the number of its descriptors, a landmark is found from any of them.
    """
    observations = len(support.descriptors) / len(support.ids)
    return HammingMap(
        support.descriptors, support.landmarks, observations * support.descriptors.shape[1] + 1
    )


def first_seen(support: Support) -> HammingMap:
    """The descriptor of the earliest keyframe."""
    return _one_each(support, support.descriptors[support.starts])


def random_sample(support: Support) -> HammingMap:
    """A descriptor drawn at random."""
    rng = np.random.default_rng(support.seed)
    rows = support.starts + rng.integers(0, support.counts)
    return _one_each(support, support.descriptors[rows])


def majority(support: Support) -> HammingMap:
    """The mean of each bit, quantised at 0.5: a bit that half of the descriptors set is set.

    Other rules for ties (clear, as in the first descriptor, at random) change the precision by
    less than its spread over seeds.
    """
    bits = 2 * support.bit_sums >= support.counts[:, None]
    return _one_each(support, np.packbits(bits, axis=1, bitorder="little"))


def bitwise_and(support: Support) -> HammingMap:
    """The bits that all of a landmark's descriptors set."""
    return _one_each(support, np.bitwise_and.reduceat(support.descriptors, support.starts, axis=0))


def medoid(support: Support) -> HammingMap:
    """The descriptor that ORB-SLAM (Mur-Artal et al. 2015) and stella_vslam keep of a landmark.

    It has the least median Hamming distance to all of the landmark's descriptors, itself included
    (of two middle values the lower one counts); ties go to the first descriptor. This is
    `MapPoint::ComputeDistinctiveDescriptors` of ORB-SLAM.
    """
    chosen = support.starts.copy()
    for size in np.unique(support.counts):
        same = np.flatnonzero(support.counts == size)
        step = max(1, _BITS // (int(size) * support.bits))
        for start in range(0, len(same), step):
            chunk = same[start : start + step]
            rows = support.starts[chunk][:, None] + np.arange(size)
            chosen[chunk] += _least_median(support.descriptors[rows])
    return _one_each(support, support.descriptors[chosen])


def _least_median(groups: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Index (g,) of the descriptor with the least median distance in each group (g, n, B)."""
    count, size, width = groups.shape
    bits = unpack_bits(groups.reshape(-1, width)).astype(np.float32).reshape(count, size, -1)
    set_bits = bits.sum(axis=2)
    # Sums of at most a few thousand ones are exact in float32.
    distances = set_bits[:, :, None] + set_bits[:, None, :] - 2 * bits @ bits.transpose(0, 2, 1)
    middle = (size - 1) // 2
    medians = np.partition(distances, middle, axis=2)[:, :, middle]
    return np.argmin(medians, axis=1)


def _one_each(support: Support, descriptors: NDArray[np.uint8]) -> HammingMap:
    return HammingMap(descriptors, support.ids, descriptors.shape[1])
