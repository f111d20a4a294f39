"""When a match between a keypoint and a landmark is accepted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.acceptance import NO_DISTANCE
from protomark.mapping.memory import Medoids, Memory, Prototypes

# As `protomark localize` accepts.
_MIN_PROBABILITY = 0.2


@dataclass(frozen=True)
class Thresholds:
    """Bounds on the distance of a match.

    Attributes:
        ratio: nearest to second nearest landmark, where the whole map is searched by a memory that
            was not calibrated.
        guided_ratio: the same among landmarks that project near the keypoint.
        max_distance: of a guided match, as a share of the distance that the frame's keypoints
            typically (median) have to landmarks elsewhere.
    """

    ratio: float
    guided_ratio: float
    max_distance: float


# A Hamming distance is a squared Euclidean one, so its ratios are squares.
_EUCLIDEAN = Thresholds(ratio=0.85, guided_ratio=0.9, max_distance=0.75)
_HAMMING = Thresholds(ratio=0.8, guided_ratio=0.85, max_distance=0.6)
# One descriptor is further from a new view than the nearest of all: with the bounds above, medoids
# lose `hololens` in its middle.
_MEDOID = Thresholds(ratio=0.9, guided_ratio=0.92, max_distance=0.75)


def thresholds(memory: Memory) -> Thresholds:
    """The bounds that fit a memory's distances."""
    if memory.euclidean:
        return _EUCLIDEAN
    return _MEDOID if isinstance(memory, Medoids) else _HAMMING


def accepted(memory: Memory, distances: NDArray[np.int32]) -> NDArray[np.int64]:
    """Which nearest landmarks of the whole map are accepted, the clearest first.

    Where the encoder was calibrated its probability decides, else the ratio of the two distances.

    Args:
        memory: what was searched.
        distances: (q, 2) int32, to the two nearest landmarks, as `Memory.search` gives them.

    Returns:
        (k,) int64, rows of `distances`.
    """
    nearest, second = distances.T
    if isinstance(memory, Prototypes) and memory.acceptance is not None:
        doubt = 1 - memory.acceptance.probability(distances)
        limit = 1 - _MIN_PROBABILITY
    else:
        with np.errstate(invalid="ignore", divide="ignore"):
            doubt = np.where(second > 0, nearest / second, 1.0)
        limit = thresholds(memory).ratio ** (2 if memory.euclidean else 1)
    rows = np.flatnonzero((nearest < NO_DISTANCE) & (doubt < limit))
    return rows[np.lexsort((nearest[rows], doubt[rows]))]
