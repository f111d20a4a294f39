"""Finds observations that matching missed, and duplicate landmarks, by projection.

COLMAP's landmarks contain what was matched. A keypoint that passes no ratio test is still an
observation of a landmark that projects to it and has a similar descriptor, and two landmarks that
project to one keypoint and have similar descriptors are one landmark. Both kinds of error would
count against every method that is measured with these labels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import InputKind
from protomark.features.distances import distances
from protomark.geometry.neighbours import near_pairs
from protomark.geometry.pose import transform
from protomark.geometry.triangulation import refine_points, widest_angle
from protomark.tracks.merging import merge
from protomark.tracks.scene import Scene


def clean(scene: Scene, max_error: float, min_angle: float, min_length: int) -> None:
    """Refine positions, remove what does not fit, and number the landmarks anew, in place.

    This removes observations with a reprojection error above `max_error` pixels, then landmarks
    with fewer than `min_length` observations or a widest angle below `min_angle` degrees. Landmarks
    are numbered by their first keypoint.
    """
    if not len(scene.positions):
        return
    scene.labels[~np.isfinite(scene.rays).all(1)] = -1
    for iterations in (5, 3):
        rows = scene.observations()
        scene.positions = refine_points(
            scene.positions,
            scene.labels[rows],
            scene.poses(rows),
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
    remaining, first = np.unique(seen, return_index=True)
    remaining = remaining[np.argsort(first, kind="stable")]
    number = np.full(count, -1, np.int64)
    number[remaining] = np.arange(len(remaining))
    scene.labels = np.where(scene.labels >= 0, number[scene.labels], -1)
    scene.positions = scene.positions[remaining]


def complete(
    scene: Scene,  # labelled keypoints; labels and positions change
    partners: list[NDArray[np.int64]],  # for each keyframe, the keyframes with an overlapping view
    max_error: float,  # largest distance in pixels between projection and keypoint
    max_distance: float,  # largest distance to the nearest descriptor of the landmark
    kind: InputKind,  # what descriptors are of
) -> tuple[int, int]:
    """Add observations in one pass over the keyframes, merge landmarks; returns both numbers."""
    added = 0
    votes: list[NDArray[np.int64]] = []
    rows = scene.observations()
    for i in range(len(partners)):
        candidates, keypoint, distance = _candidates(scene, i, partners[i], rows, max_error, kind)
        fits = distance <= max_distance
        candidates, keypoint, distance = candidates[fits], keypoint[fits], distance[fits]
        label = scene.labels[keypoint]
        free = label < 0
        votes.append(np.sort(np.column_stack([candidates, label])[~free], axis=1))
        candidates, keypoint, distance = candidates[free], keypoint[free], distance[free]
        best = _best(candidates, distance) & _best(keypoint, distance)
        # Of equal distances, the first keypoint and the first landmark count.
        _, once = np.unique(keypoint[best], return_index=True)
        chosen, label = keypoint[best][once], candidates[best][once]
        _, once = np.unique(label, return_index=True)
        scene.labels[chosen[once]] = label[once]
        added += len(once)
    return added, merge(scene, np.concatenate(votes), max_error)


def _best(key: NDArray[np.int64], distance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether each entry has the smallest distance of all entries with its key."""
    if not len(key):
        return np.zeros(0, bool)
    _, group_of = np.unique(key, return_inverse=True)
    smallest = np.full(group_of.max() + 1, np.inf, np.float32)
    np.minimum.at(smallest, group_of, distance)
    out: NDArray[np.bool_] = distance == smallest[group_of]
    return out


def _candidates(
    scene: Scene,
    keyframe: int,
    partners: NDArray[np.int64],
    rows: NDArray[np.int64],
    radius: float,
    kind: InputKind,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Landmarks that partners but not this keyframe observe, and keypoints they project to.

    The third array is the distance of the keypoint to the landmark's nearest descriptor.
    """
    nothing = np.zeros(0, np.int64)
    here = slice(int(scene.offsets[keyframe]), int(scene.offsets[keyframe + 1]))
    seen = np.zeros(len(scene.positions), bool)
    for p in partners:
        labels = scene.labels[scene.offsets[p] : scene.offsets[p + 1]]
        seen[labels[labels >= 0]] = True
    labels = scene.labels[here]
    seen[labels[labels >= 0]] = False
    landmarks = np.flatnonzero(seen)
    camera = scene.model.cameras[int(scene.model.camera_ids[keyframe])]
    pose = scene.model.cam_from_world[keyframe]
    pixels = camera.project(transform(pose, scene.positions[landmarks]))
    inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
    landmarks, pixels = landmarks[inside], pixels[inside]
    a, b = near_pairs(pixels, scene.keypoints[here].astype(np.float64), radius)
    if not len(a):
        return nothing, nothing, np.zeros(0, np.float32)
    landmarks, keypoints = landmarks[a], b + here.start
    # Pair all descriptors of each landmark with the keypoint's.
    at, length = scene.rows_of(landmarks, rows)
    pair = scene.descriptors[at], scene.descriptors[np.repeat(keypoints, length)]
    smallest = np.minimum.reduceat(distances(*pair, kind), np.cumsum(length) - length)
    return landmarks, keypoints, smallest
