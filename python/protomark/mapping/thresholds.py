"""Decides which matches between keypoints and landmarks are accepted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.mapping.memory import Medoids, Memory, Prototypes
from protomark.matching import MIN_PROBABILITY


@dataclass(frozen=True)
class Thresholds:
    """Bounds on the distance of a match.

    Attributes:
        ratio: largest ratio of the distances to the nearest and second nearest landmark, where the
            whole map is searched by a memory without calibration.
        guided_ratio: the same among landmarks that project near the keypoint.
        max_distance: largest distance among landmarks that project near the keypoint, as a share of
            the median distance between keypoints and landmarks elsewhere.
    """

    ratio: float
    guided_ratio: float
    max_distance: float


# A Hamming distance is a squared Euclidean one, so its ratios are squares.
_EUCLIDEAN = Thresholds(ratio=0.85, guided_ratio=0.9, max_distance=0.75)
_HAMMING = Thresholds(ratio=0.8, guided_ratio=0.85, max_distance=0.6)
# A medoid is further from a new view than the nearest of all descriptors: with the bounds above,
# mapping with medoids loses `hololens` in the middle.
_MEDOID = Thresholds(ratio=0.9, guided_ratio=0.92, max_distance=0.75)


def thresholds(memory: Memory) -> Thresholds:
    """The bounds that fit a memory's distances."""
    if memory.euclidean:
        return _EUCLIDEAN
    return _MEDOID if isinstance(memory, Medoids) else _HAMMING


def accepted_rows(memory: Memory, distances: NDArray[np.float32]) -> NDArray[np.int64]:
    """Rows whose nearest landmark in the whole map is accepted, the clearest first.

    If the encoder was calibrated the probability decides, else the ratio of the two distances.

    Args:
        memory: what was searched.
        distances: (q, 2) float32, to the two nearest landmarks.

    Returns:
        (k,) int64, rows of `distances`.
    """
    nearest, second = distances.T
    if isinstance(memory, Prototypes) and memory.calibration is not None:
        doubt = 1 - memory.calibration.probability(distances)
        limit = 1 - MIN_PROBABILITY
    else:
        with np.errstate(invalid="ignore", divide="ignore"):
            doubt = np.where(second > 0, nearest / second, 1.0)
        limit = thresholds(memory).ratio
    rows = np.flatnonzero(np.isfinite(nearest) & (doubt < limit))
    return rows[np.lexsort((nearest[rows], doubt[rows]))]
