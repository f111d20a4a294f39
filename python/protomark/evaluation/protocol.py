"""The paper's protocol: a split into keyframes that build the map, and queries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Tracks

SUPPORT_SHARE = 0.9
MIN_OBSERVATIONS = 2
MAX_QUERIES = 10_000


@dataclass(frozen=True)
class SupportQuerySplit:
    """Support and queries of one sequence at one seed."""

    seed: int  # seed of the split
    # (s,) int64, ascending indices of the keyframes that build the map.
    support_keyframes: NDArray[np.int64]
    query_keyframes: NDArray[np.int64]  # (m - s,) int64, ascending indices of the others
    # (o,) int64, ascending keypoint rows whose landmark is in the map.
    support_rows: NDArray[np.int64]
    # (q,) int64, ascending keypoint rows of the queries, whose landmarks are in the map.
    query_rows: NDArray[np.int64]


def split(
    tracks: Tracks,
    seed: int,
    *,
    support_share: float = SUPPORT_SHARE,
    min_observations: int = MIN_OBSERVATIONS,
    max_queries: int = MAX_QUERIES,
) -> SupportQuerySplit:
    """Draw support and queries as in Komorowski and Trzcinski, section "Performance metric".

    A random `support_share` of the keyframes is the support, rounded to the nearest number that
    leaves at least one keyframe on either side. A landmark is in the map if the support observes
    it at least `min_observations` times. Queries are up to `max_queries` observations of such
    landmarks in the other keyframes, drawn at random.

    The same tracks and seed give the same split on every platform.

    Raises:
        ValueError: the tracks are augmented, there are fewer than two keyframes, or no landmark
            that both sides see.
    """
    if tracks.info.get("augmentations"):
        raise ValueError(
            "these tracks hold augmented copies of each keyframe, which are for training only: "
            "give the plain tracks"
        )
    keyframes = len(tracks.keyframe_names)
    if keyframes < 2:
        raise ValueError(
            f"{keyframes} keyframe(s) cannot be split into support and queries: give tracks of "
            "at least 2"
        )
    rng = np.random.default_rng(seed)
    order = rng.permutation(keyframes)
    # Halves are rounded up, where round() would round them to even.
    size = min(max(int(keyframes * support_share + 0.5), 1), keyframes - 1)
    in_support = np.zeros(keyframes, dtype=bool)
    in_support[order[:size]] = True

    observations = tracks.observations
    landmark = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[observations])
    supported = in_support[tracks.keyframe_of_keypoint[observations]]
    seen = np.bincount(landmark[supported], minlength=len(tracks.landmark_ids))
    in_map = seen[landmark] >= min_observations

    query_rows = observations[in_map & ~supported]
    if not len(query_rows):
        raise ValueError(
            f"no query keyframe observes a landmark with {min_observations} support observations "
            f"(seed {seed}), so these tracks are too few or too short: give longer ones"
        )
    if len(query_rows) > max_queries:
        query_rows = np.sort(rng.choice(query_rows, size=max_queries, replace=False))
    return SupportQuerySplit(
        seed=seed,
        support_keyframes=np.flatnonzero(in_support),
        query_keyframes=np.flatnonzero(~in_support),
        support_rows=observations[in_map & supported],
        query_rows=query_rows,
    )
