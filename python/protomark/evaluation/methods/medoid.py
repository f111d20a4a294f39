"""The one descriptor of a landmark that is closest to its others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.hamming_map import HammingMap
from protomark.evaluation.support import Support, unpack

# Landmarks of equal size are compared together, as many at a time as make this many bits.
_BITS = 1 << 24


def medoid(support: Support) -> HammingMap:
    """What ORB-SLAM (Mur-Artal et al. 2015) and stella_vslam keep of a landmark.

    Of each descriptor, the median of its Hamming distances to all of the landmark's descriptors,
    itself included (the lower one of two middle values); the least median wins, on a tie the
    first. This is `MapPoint::ComputeDistinctiveDescriptors` of ORB-SLAM.
    """
    chosen = support.starts.copy()
    for size in np.unique(support.counts):
        same = np.flatnonzero(support.counts == size)
        step = max(1, _BITS // (int(size) * support.bits))
        for at in range(0, len(same), step):
            some = same[at : at + step]
            rows = support.starts[some][:, None] + np.arange(size)
            chosen[some] += _least_median(support.descriptors[rows])
    return HammingMap(support.descriptors[chosen], support.ids, support.descriptors.shape[1])


def _least_median(groups: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(g, n, bytes) uint8 -> (g,) which of the n has the least median distance."""
    many, size, width = groups.shape
    bits = unpack(groups.reshape(-1, width)).astype(np.float32).reshape(many, size, -1)
    set_bits = bits.sum(axis=2)
    # Sums of at most a few thousand ones: exact in float32.
    distances = set_bits[:, :, None] + set_bits[:, None, :] - 2 * bits @ bits.transpose(0, 2, 1)
    middle = (size - 1) // 2
    medians = np.partition(distances, middle, axis=2)[:, :, middle]
    return np.argmin(medians, axis=1)
