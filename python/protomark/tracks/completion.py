"""Observations that matching missed, and landmarks that are one: found by projection.

COLMAP joins what was matched. A keypoint that passed no ratio test, though it lies where a landmark
projects and looks like it, is still an observation of it; and two landmarks that project to one
keypoint and look alike are one landmark. Both kinds of error would count against every method
that is measured with these labels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.colmap import Model, project
from protomark.tracks.geometry import group, refine_points, residuals, widest_angle

# Landmarks this close (pixels) are one, though detection found two keypoints in some keyframe.
SAME_POINT = 2.0
_POPCOUNT = np.array([bin(i).count("1") for i in range(256)], np.uint8)


@dataclass
class Scene:
    """All keypoints of all keyframes, and their landmarks.

    Attributes:
        model: cameras and m poses.
        offsets: (m + 1,) int64, rows of each keyframe.
        keyframe: (n,) int64, keyframe of each keypoint.
        keypoints: (n, 2) float32, pixels.
        rays: (n, 2) float64, undistorted, NaN where that failed.
        focal: (n,) float64, focal length in pixels.
        descriptors: (n, bits / 8) uint8.
        labels: (n,) int64, row in positions, -1 where none.
        positions: (l, 3) float64.
    """

    model: Model
    offsets: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    rays: NDArray[np.float64]
    focal: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    labels: NDArray[np.int64]
    positions: NDArray[np.float64]

    def observations(self) -> NDArray[np.int64]:
        """Rows with a landmark, sorted by landmark, then by row."""
        rows = np.flatnonzero(self.labels >= 0)
        return rows[np.argsort(self.labels[rows], kind="stable")]

    def errors(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Reprojection error in pixels of observations, infinite behind the camera.

        Measured in the undistorted image, scaled by the focal length.
        """
        difference, depth = residuals(
            self.positions[self.labels[rows]],
            self.model.cam_from_world[self.keyframe[rows]],
            self.rays[rows],
        )
        error = np.linalg.norm(difference, axis=1) * self.focal[rows]
        return np.where((depth > 0) & np.isfinite(error), error, np.inf)


def clean(scene: Scene, max_error: float, min_angle: float, min_length: int) -> None:
    """Refine positions, drop what does not fit, and number the landmarks anew, in place.

    Dropped are observations with a reprojection error above `max_error` pixels, then landmarks with
    fewer than `min_length` observations or a widest angle below `min_angle` degrees. Landmarks are
    numbered by their first keypoint.
    """
    if not len(scene.positions):
        return
    scene.labels[~np.isfinite(scene.rays).all(1)] = -1
    for iterations in (5, 3):
        rows = scene.observations()
        scene.positions = refine_points(
            scene.positions,
            scene.labels[rows],
            scene.model.cam_from_world[scene.keyframe[rows]],
            scene.rays[rows],
            scene.focal[rows],
            iterations,
        )
        scene.labels[rows[scene.errors(rows) > max_error]] = -1
    rows = scene.observations()
    count = len(scene.positions)
    angle = widest_angle(
        scene.positions, scene.labels[rows], scene.model.centers[scene.keyframe[rows]]
    )
    length = np.bincount(scene.labels[rows], minlength=count)
    keep = (length >= min_length) & (angle >= np.radians(min_angle))
    keep &= np.isfinite(scene.positions).all(1)
    scene.labels[(scene.labels >= 0) & ~keep[scene.labels]] = -1
    seen = scene.labels[scene.labels >= 0]
    kept, first = np.unique(seen, return_index=True)
    kept = kept[np.argsort(first, kind="stable")]
    number = np.full(count, -1, np.int64)
    number[kept] = np.arange(len(kept))
    scene.labels = np.where(scene.labels >= 0, number[scene.labels], -1)
    scene.positions = scene.positions[kept]


def complete(
    scene: Scene,
    partners: list[NDArray[np.int64]],
    max_error: float,
    max_distance: int,
) -> tuple[int, int]:
    """One pass over the keyframes: add observations, then merge landmarks, in place.

    Args:
        scene: labelled keypoints; labels and positions change.
        partners: for each keyframe, the keyframes that see the same things.
        max_error: largest distance in pixels between projection and keypoint.
        max_distance: largest Hamming distance in bits to the nearest descriptor of the landmark.

    Returns:
        How many observations were added, how many landmarks were merged into another.
    """
    added = 0
    votes: list[NDArray[np.int64]] = []
    rows = scene.observations()
    for i in range(len(partners)):
        candidates, keypoint, distance = _candidates(scene, i, partners[i], rows, max_error)
        fits = distance <= max_distance
        candidates, keypoint, distance = candidates[fits], keypoint[fits], distance[fits]
        holder = scene.labels[keypoint]
        taken = holder >= 0
        votes.append(
            np.column_stack(
                [np.minimum(candidates, holder)[taken], np.maximum(candidates, holder)[taken]]
            )
        )
        candidates, keypoint, distance = candidates[~taken], keypoint[~taken], distance[~taken]
        best = _best(candidates, distance) & _best(keypoint, distance)
        # Equal distances: the first keypoint, the first landmark.
        _, once = np.unique(keypoint[best], return_index=True)
        chosen, label = keypoint[best][once], candidates[best][once]
        _, once = np.unique(label, return_index=True)
        scene.labels[chosen[once]] = label[once]
        added += len(once)
    return added, _merge(
        scene, np.concatenate(votes) if votes else np.zeros((0, 2), np.int64), max_error
    )


def _best(key: NDArray[np.int64], distance: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each entry has the smallest distance among those of its key."""
    if not len(key):
        return np.zeros(0, bool)
    _, group_of = np.unique(key, return_inverse=True)
    smallest = np.full(group_of.max() + 1, np.iinfo(np.int64).max)
    np.minimum.at(smallest, group_of, distance)
    out: NDArray[np.bool_] = distance == smallest[group_of]
    return out


def _candidates(
    scene: Scene,
    keyframe: int,
    partners: NDArray[np.int64],
    rows: NDArray[np.int64],
    radius: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Landmarks that partners see and this keyframe does not, with keypoints where they project.

    Returns:
        landmark, keypoint row and Hamming distance to the nearest of the landmark's descriptors.
    """
    nothing = np.zeros(0, np.int64)
    own = slice(int(scene.offsets[keyframe]), int(scene.offsets[keyframe + 1]))
    seen = np.zeros(len(scene.positions), bool)
    for p in partners:
        labels = scene.labels[scene.offsets[p] : scene.offsets[p + 1]]
        seen[labels[labels >= 0]] = True
    labels = scene.labels[own]
    seen[labels[labels >= 0]] = False
    landmarks = np.flatnonzero(seen)
    camera = scene.model.cameras[int(scene.model.camera_ids[keyframe])]
    pose = scene.model.cam_from_world[keyframe]
    pixels = project(camera, scene.positions[landmarks] @ pose[:, :3].T + pose[:, 3])
    # NaN, behind the camera, is not inside.
    inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
    landmarks, pixels = landmarks[inside], pixels[inside]
    a, b = within(pixels, scene.keypoints[own].astype(np.float64), radius)
    if not len(a):
        return nothing, nothing, nothing
    landmarks, keypoints = landmarks[a], b + own.start
    # All descriptors of each landmark, next to the keypoint's.
    sorted_labels = scene.labels[rows]
    start = np.searchsorted(sorted_labels, landmarks, "left")
    length = np.searchsorted(sorted_labels, landmarks, "right") - start
    pair = np.repeat(np.arange(len(landmarks)), length)
    at = np.arange(len(pair)) - np.repeat(np.cumsum(length) - length, length) + start[pair]
    bits = scene.descriptors[rows[at]] ^ scene.descriptors[keypoints[pair]]
    distance = _POPCOUNT[bits].sum(1, dtype=np.int64)
    smallest = np.minimum.reduceat(distance, np.cumsum(length) - length)
    return landmarks, keypoints, smallest


def within(
    first: NDArray[np.float64], second: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index pairs of points (n, 2) and (m, 2) at most `radius` apart; coordinates >= -radius."""
    if not len(first) or not len(second):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    a, b = (np.floor(p / radius).astype(np.int64) + 2 for p in (first, second))
    stride = int(max(a[:, 0].max(), b[:, 0].max())) + 3
    key = b[:, 1] * stride + b[:, 0]
    order = np.argsort(key, kind="stable")
    key = key[order]
    left, right = [], []
    for row in (-1, 0, 1):
        # Three cells side by side are one run of keys.
        base = (a[:, 1] + row) * stride + a[:, 0]
        start, stop = (
            np.searchsorted(key, base - 1, "left"),
            np.searchsorted(key, base + 1, "right"),
        )
        length = stop - start
        i = np.repeat(np.arange(len(first)), length)
        at = np.arange(len(i)) - np.repeat(np.cumsum(length) - length, length) + start[i]
        left.append(i)
        right.append(order[at])
    i, j = np.concatenate(left), np.concatenate(right)
    near = ((first[i] - second[j]) ** 2).sum(1) <= radius * radius
    i, j = i[near], j[near]
    order = np.lexsort((j, i))
    return i[order], j[order]


def _merge(scene: Scene, votes: NDArray[np.int64], max_error: float) -> int:
    """Merge landmarks that were voted one and fit one position.

    Two landmarks that share a keyframe merge only if they lie within `SAME_POINT` pixels of each
    other; in a shared keyframe the keypoint that fits better keeps the landmark.
    """
    if not len(votes):
        return 0
    pairs, count = np.unique(votes, axis=0, return_counts=True)
    pairs = pairs[np.argsort(-count, kind="stable")]
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    rows = scene.observations()
    close = _apart(scene, pairs, rows) <= SAME_POINT
    starts, lengths = group(scene.labels[rows])
    keyframes = {
        int(scene.labels[rows[s]]): set(scene.keyframe[rows[s : s + n]].tolist())
        for s, n in zip(starts, lengths, strict=True)
    }
    used: set[int] = set()
    into = np.arange(len(scene.positions))
    for (keep, drop), near in zip(pairs.tolist(), close.tolist(), strict=True):
        if keep in used or drop in used:
            continue
        if near or keyframes.get(keep, set()).isdisjoint(keyframes.get(drop, set())):
            used.update((keep, drop))
            into[drop] = keep
    before = scene.labels[rows]
    after = into[before]
    touched = np.isin(after, after[after != before])
    rows, before, after = rows[touched], before[touched], after[touched]
    if not len(rows):
        return 0
    poses, seen = scene.model.cam_from_world[scene.keyframe[rows]], scene.rays[rows]
    moved = refine_points(scene.positions, after, poses, seen, scene.focal[rows])
    difference, depth = residuals(moved[after], poses, seen)
    error = np.where(depth > 0, np.linalg.norm(difference, axis=1) * scene.focal[rows], np.inf)
    # Of two keypoints in one keyframe the better one counts, the other loses its landmark.
    order = np.lexsort((error, scene.keyframe[rows], after))
    again = (np.diff(after[order], prepend=-1) == 0) & (
        np.diff(scene.keyframe[rows[order]], prepend=-1) == 0
    )
    spare = np.zeros(len(rows), bool)
    spare[order[again]] = True
    bad = np.unique(after[(error > max_error) & ~spare])
    fine = ~np.isin(after, bad)
    scene.labels[rows[fine]] = np.where(spare[fine], -1, after[fine])
    scene.positions[after[fine]] = moved[after[fine]]
    return len(np.unique(before[fine][before[fine] != after[fine]]))


def _apart(scene: Scene, pairs: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Median distance (n,) in pixels between two landmarks, over the keyframes of the first."""
    labels = scene.labels[rows]
    start = np.searchsorted(labels, pairs[:, 0], "left")
    length = np.searchsorted(labels, pairs[:, 0], "right") - start
    pair = np.repeat(np.arange(len(pairs)), length)
    at = rows[np.arange(len(pair)) - np.repeat(np.cumsum(length) - length, length) + start[pair]]
    poses = scene.model.cam_from_world[scene.keyframe[at]]
    nothing = np.zeros((len(at), 2))
    first, _ = residuals(scene.positions[pairs[pair, 0]], poses, nothing)
    second, _ = residuals(scene.positions[pairs[pair, 1]], poses, nothing)
    distance = np.linalg.norm(first - second, axis=1) * scene.focal[at]
    order = np.lexsort((distance, pair))
    out = np.full(len(pairs), np.inf)
    has = length > 0
    out[has] = distance[order[(np.cumsum(length) - length + length // 2)[has]]]
    return out
