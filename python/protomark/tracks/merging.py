"""Merges duplicate landmarks where votes, poses and keyframes agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.neighbours import runs
from protomark.geometry.triangulation import pixel_errors, refine_points, reprojection_residuals
from protomark.tracks.scene import Scene

# Landmarks this close (pixels) are one, even if they have two keypoints in some keyframe.
SAME_POINT = 2.0
# Share of a merged landmark's observations that may not fit, and are removed.
_MISFITS = 0.1
_ROUNDS = 8


def merge(scene: Scene, votes: NDArray[np.int64], max_error: float) -> int:
    """Merge landmarks that have votes and fit one position, in place.

    Two landmarks merge if they project within `max_error` pixels of each other, or within
    `SAME_POINT` if they share a keyframe, in which the keypoint that fits better keeps the
    landmark. In each round a landmark takes part in one merge, so that a chain of duplicates merges
    over several rounds.

    Returns:
        Number of landmarks that were merged into another.
    """
    merged = 0
    for _ in range(_ROUNDS):
        votes = np.sort(votes[votes[:, 0] != votes[:, 1]], axis=1)
        if not len(votes):
            break
        into, refused = _round(scene, votes, max_error)
        merged += int((into != np.arange(len(into))).sum())
        tried = refused[votes[:, 0]] == votes[:, 1]
        votes = into[votes[~tried]]
        if not tried.any() and (into == np.arange(len(into))).all():
            break
    return merged


def _round(
    scene: Scene, votes: NDArray[np.int64], max_error: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Merge pairs that have no landmark in common.

    Returns:
        The landmark (l,) that each one is now part of; and the landmark (l,) of a higher row whose
        merge with each one failed, -1 for none.
    """
    pairs, count = np.unique(votes, axis=0, return_counts=True)
    rows = scene.observations()
    labels, keyframes = scene.labels[rows], scene.keyframe[rows]
    apart = _apart(scene, pairs, rows)
    near = apart <= SAME_POINT
    eligible = near | ((apart <= max_error) & ~_share_keyframe(pairs, labels, keyframes))
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -count, ~near))
    into = np.arange(len(scene.positions))
    refused = np.full(len(into), -1)
    used = np.zeros(len(into), bool)
    for keep, drop in pairs[order][eligible[order]].tolist():
        if not used[keep] and not used[drop]:
            used[keep] = used[drop] = True
            into[drop] = keep
    after = into[labels]
    touched = np.isin(after, after[after != labels])
    rows, after, keyframes = rows[touched], after[touched], keyframes[touched]
    if not len(rows):
        return into, refused
    poses, seen, focal = scene.poses(rows), scene.rays[rows], scene.focal[rows]
    moved = refine_points(scene.positions, after, poses, seen, focal)
    error = pixel_errors(moved[after], poses, seen, focal)
    # Of two keypoints in one keyframe the better one keeps the landmark.
    order = np.lexsort((error, keyframes, after))
    again = (np.diff(after[order], prepend=-1) == 0) & (np.diff(keyframes[order], prepend=-1) == 0)
    spare = np.zeros(len(rows), bool)
    spare[order[again]] = True
    misfit = (error > max_error) & ~spare
    total = np.bincount(after[~spare], minlength=len(into))
    bad = np.bincount(after[misfit], minlength=len(into)) > _MISFITS * total
    failed = np.flatnonzero(bad[into] & (into != np.arange(len(into))))
    refused[into[failed]] = failed
    into[failed] = failed
    merged = ~bad[after]
    scene.labels[rows[merged]] = np.where(spare[merged] | misfit[merged], -1, after[merged])
    scene.positions[after[merged]] = moved[after[merged]]
    return into, refused


def _share_keyframe(
    pairs: NDArray[np.int64], labels: NDArray[np.int64], keyframes: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether a keyframe observes both landmarks of each pair (n, 2); labels ascend."""
    starts, lengths = runs(labels)
    seen = {
        int(labels[s]): frozenset(keyframes[s : s + n].tolist())
        for s, n in zip(starts, lengths, strict=True)
    }
    empty: frozenset[int] = frozenset()
    shared = [not seen.get(a, empty).isdisjoint(seen.get(b, empty)) for a, b in pairs.tolist()]
    return np.array(shared, bool)


def _apart(scene: Scene, pairs: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Median distance (n,) in pixels between the landmarks of pairs, in keyframes of the first."""
    at, length = scene.rows_of(pairs[:, 0], rows)
    pair = np.repeat(np.arange(len(pairs)), length)
    poses = scene.poses(at)
    first, second = (
        reprojection_residuals(scene.positions[pairs[pair, k]], poses, np.zeros((len(at), 2)))[0]
        for k in (0, 1)
    )
    distance = np.linalg.norm(first - second, axis=1) * scene.focal[at]
    order = np.lexsort((distance, pair))
    out = np.full(len(pairs), np.inf)
    has = length > 0
    out[has] = distance[order[(np.cumsum(length) - length + length // 2)[has]]]
    return out
