"""When a match between a keypoint and a landmark is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from protomark.mapping.memory import Memory


@dataclass(frozen=True)
class Thresholds:
    """Bounds on the distance of a match.

    Attributes:
        ratio: nearest to second nearest landmark, where the whole map is searched.
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


def thresholds(memory: Memory) -> Thresholds:
    """The bounds that fit a memory's distances."""
    return _EUCLIDEAN if memory.euclidean else _HAMMING
