"""Splits of a sequence into keyframes that build the map and keyframes that query it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Tracks

SUPPORT_SHARE = 0.9
# A split by time is cut between these shares of the keyframes. This share after the cut is left
# out, so that no query is next to what the map has seen.
CUTS = (0.5, 0.7)
GAP = 0.1
MIN_OBSERVATIONS = 2
MAX_QUERIES = 10_000

SplitKind = Literal["random", "later"]


@dataclass(frozen=True)
class SupportQuerySplit:
    """Support and queries of one sequence at one seed."""

    seed: int  # seed of the split
    # (s,) int64, ascending indices of the keyframes that build the map.
    support_keyframes: NDArray[np.int64]
    query_keyframes: NDArray[np.int64]  # ascending indices of the keyframes that query
    # (o,) int64, ascending keypoint rows whose landmark is in the map.
    support_rows: NDArray[np.int64]
    # (q,) int64, ascending keypoint rows of the queries, whose landmarks are in the map.
    query_rows: NDArray[np.int64]


def split(
    tracks: Tracks,
    seed: int,
    kind: SplitKind = "random",
    *,
    support_share: float = SUPPORT_SHARE,
    min_observations: int = MIN_OBSERVATIONS,
    max_queries: int = MAX_QUERIES,
) -> SupportQuerySplit:
    """Draw support and queries.

    "random" is the protocol of Komorowski and Trzcinski, section "Performance metric": a random
    `support_share` of the keyframes is the support, rounded to the nearest number that leaves at
    least one keyframe on either side, and the others query.

    "later" asks for revisits: the keyframes before a cut are the support, and those that come at
    least a share `GAP` of all keyframes after it query. The cut is drawn between the shares `CUTS`.
    Keyframes are taken to be in the order of time.

    A landmark is in the map if the support observes it at least `min_observations` times. Queries
    are up to `max_queries` observations of such landmarks in the query keyframes, drawn at random.

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
    if kind == "random":
        order = rng.permutation(keyframes)
        # Halves are rounded up, where round() would round them to even.
        size = min(max(int(keyframes * support_share + 0.5), 1), keyframes - 1)
        support_keyframes, query_keyframes = np.sort(order[:size]), np.sort(order[size:])
    else:
        first, last = (int(keyframes * share) for share in CUTS)
        cut = int(rng.integers(first, last + 1))
        support_keyframes = np.arange(cut)
        query_keyframes = np.arange(cut + int(keyframes * GAP), keyframes)

    observations = tracks.observations
    landmark = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[observations])
    keyframe = tracks.keyframe_of_keypoint[observations]
    supported = np.isin(keyframe, support_keyframes)
    seen = np.bincount(landmark[supported], minlength=len(tracks.landmark_ids))
    in_map = seen[landmark] >= min_observations

    query_rows = observations[in_map & np.isin(keyframe, query_keyframes)]
    if not len(query_rows):
        raise ValueError(
            f"no query keyframe observes a landmark with {min_observations} support observations "
            f"({kind} split, seed {seed}), so "
            + (
                "these tracks are too few or too short: give longer ones"
                if kind == "random"
                else "the camera never comes back: give tracks that revisit what they saw, or "
                "take the random split"
            )
        )
    if len(query_rows) > max_queries:
        query_rows = np.sort(rng.choice(query_rows, size=max_queries, replace=False))
    return SupportQuerySplit(
        seed=seed,
        support_keyframes=support_keyframes,
        query_keyframes=query_keyframes,
        support_rows=observations[in_map & supported],
        query_rows=query_rows,
    )
