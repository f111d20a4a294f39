"""Matches of a frame with a map, each with the probability that it is right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import protomark as pm
from protomark import _core
from protomark.maps.sharded_map import ShardedMap

# Smallest probability of an accepted match, chosen on the training and validation sequences.
MIN_PROBABILITY = 0.2


@dataclass(frozen=True)
class MatchList:
    """a accepted matches of one frame, the likeliest first.

    Attributes:
        keypoints: (a,) int64, rows of the descriptors, each at most once.
        landmarks: (a,) int64, landmark ids, each at most once.
        probabilities: (a,) float64, the probability that each match is right.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    probabilities: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.keypoints)


def match(
    scene: pm.PrototypeMap | pm.SealedMap | ShardedMap,
    descriptors: NDArray[np.uint8],
    *,
    min_probability: float = MIN_PROBABILITY,
    threads: int = 1,
    recall: float | None = None,
    among: ArrayLike | None = None,
) -> MatchList:
    """Match the keypoints of a frame with the landmarks of a map.

    Args:
        scene: a learning, sealed or sharded map whose encoder has a match calibration.
        descriptors: (n, bits / 8) uint8.
        min_probability: smallest probability of an accepted match, in [0, 1].
        threads: threads to encode and search on.
        recall: share of nearest landmarks to find by approximate search; None: exact search.
        among: landmarks to search, as in `search`.

    Returns:
        The accepted matches: each landmark has the likeliest of its keypoints only.

    Raises:
        ValueError: the map's encoder was not calibrated or takes other descriptors, or
            `min_probability` is not 0 to 1.
    """
    if isinstance(scene, ShardedMap):
        calibration = scene.encoder.match_calibration(scene.dim, scene.tuned)
        ids, distances = scene.search(descriptors, 2, threads=threads, recall=recall, among=among)
        return accept(ids[:, 0], calibration.probability(distances), min_probability)
    return MatchList(*_core.match(scene, descriptors, min_probability, threads, recall, among))


def accept(
    nearest: NDArray[np.int64],
    probabilities: NDArray[np.float64],
    min_probability: float = MIN_PROBABILITY,
) -> MatchList:
    """Accept the matches that are likely enough; a landmark keeps its likeliest keypoint.

    Args:
        nearest: (n,) int64, the nearest landmark of each keypoint, -1 where there is none.
        probabilities: (n,) float64, the probability that it is right.
        min_probability: smallest probability of an accepted match.
    """
    return MatchList(*_core.accept(nearest, probabilities, min_probability))
