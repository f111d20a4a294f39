"""Matches of one frame with a map, each with the probability that it is right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm
from protomark import _core

# Less likely matches are not accepted. Chosen on the training and validation sequences
# (docs/localization.md).
MIN_PROBABILITY = 0.2


@dataclass(frozen=True)
class Matches:
    """Accepted matches of one frame, the likeliest first.

    Attributes:
        keypoints: (a,) int64, rows of the descriptors, each at most once.
        landmarks: (a,) int64, ids, each at most once.
        probabilities: (a,) float64, that the match is right.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    probabilities: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.keypoints)


def match(
    scene: pm.PrototypeMap | pm.SealedMap,
    descriptors: NDArray[np.uint8],
    *,
    min_probability: float = MIN_PROBABILITY,
    threads: int = 1,
    recall: float | None = None,
    among: ArrayLike | None = None,
) -> Matches:
    """The landmarks that the keypoints of a frame see.

    Args:
        scene: a map, whose encoder says how likely a match is (`Encoder.match_calibration`).
        descriptors: (n, bits / 8) uint8.
        min_probability: of an accepted match.
        threads: threads to encode and search on.
        recall: see `search`.
        among: landmarks to search, as in `search`.

    Raises:
        ValueError: the map's encoder was not calibrated, the descriptors are not its own, or
            `min_probability` is not 0 to 1.
    """
    return Matches(*_core.match(scene, descriptors, min_probability, threads, recall, among))


def accept(
    nearest: NDArray[np.int64],
    probabilities: NDArray[np.float64],
    min_probability: float = MIN_PROBABILITY,
) -> Matches:
    """Matches that are likely enough; a landmark keeps its likeliest keypoint.

    Args:
        nearest: (n,) int64, the nearest landmark of each keypoint, -1 where there is none.
        probabilities: (n,) float64, that it is the right one.
        min_probability: of an accepted match.
    """
    return Matches(*_core.accept(nearest, probabilities, min_probability))
