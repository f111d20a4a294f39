"""The first two frames: their relative pose, once there is enough parallax to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import protomark as pm
from protomark.mapping.sighting import Sighting
from protomark.mapping.structure import Array, Ids
from protomark.tracks.colmap import focal_length
from protomark.tracks.file import Camera
from protomark.tracks.geometry import depth_of_first, epipolar_error

RATIO = 0.8
# Fewest matches that must agree with the relative pose, and be far enough apart in angle.
_MIN_MATCHES = 60
_MIN_POINTS = 50
# Median angle between the two rays of a match, degrees.
_MIN_PARALLAX = 2.0
# Where this share of matches is explained by a turn on the spot, there is no parallax.
_MAX_TURNED = 0.5
_MAX_WAITING = 40


@dataclass
class TwoView:
    """The relative pose of two frames, the first one at the origin.

    Attributes:
        first: place in `Initialiser.waiting`.
        second: place in `Initialiser.waiting`.
        pose: (3, 4) float64, of the second; the translation has length 1.
    """

    first: int
    second: int
    pose: Array


class Initialiser:
    """Collects frames until two of them show the scene from places far enough apart.

    Args:
        camera: camera of all frames.
        max_error: largest epipolar error in pixels.
    """

    def __init__(self, camera: Camera, max_error: float) -> None:
        self.camera, self.max_error = camera, max_error
        self.waiting: list[Sighting] = []
        self.best_parallax = 0.0

    def push(self, sighting: Sighting) -> TwoView | None:
        """Try the new frame with those that wait, the oldest first; it then waits, too."""
        self.waiting.append(sighting)
        if len(self.waiting) > _MAX_WAITING:
            del self.waiting[0]
        last = len(self.waiting) - 1
        for first in range(last):
            pose = self._relative_pose(self.waiting[first], sighting)
            if pose is not None:
                return TwoView(first, last, pose)
        return None

    def _relative_pose(self, first: Sighting, second: Sighting) -> Array | None:
        import poselib

        rows = match(first, second)
        if len(rows) < _MIN_MATCHES:
            return None
        a, b = rows[:, 0], rows[:, 1]
        camera = self.camera.as_dict()
        found, facts = poselib.estimate_relative_pose(
            first.keypoints[a].astype(np.float64),
            second.keypoints[b].astype(np.float64),
            camera,
            camera,
            {"max_epipolar_error": self.max_error, "seed": 0, "max_iterations": 2000},
            {},
        )
        inliers = np.asarray(facts["inliers"], bool)
        if inliers.sum() < _MIN_MATCHES or inliers.mean() < 0.5:
            return None
        pose = np.asarray(found.Rt, np.float64)
        ray_a, ray_b = first.rays[a[inliers]], second.rays[b[inliers]]
        scale = focal_length(self.camera)
        if _turned(pose[:, :3], ray_a, ray_b, 2 * self.max_error / scale) > _MAX_TURNED:
            return None
        depth, angle = depth_of_first(pose[:, :3], pose[:, 3], ray_a, ray_b)
        good = depth > 0
        good &= epipolar_error(pose[:, :3], pose[:, 3], ray_a, ray_b) * scale <= self.max_error
        parallax = float(np.degrees(np.median(angle[good]))) if good.any() else 0.0
        self.best_parallax = max(self.best_parallax, parallax)
        wide = good & (angle > np.radians(0.5 * _MIN_PARALLAX))
        if wide.sum() < _MIN_POINTS or good.mean() < 0.8 or parallax < _MIN_PARALLAX:
            return None
        return pose


def match(first: Sighting, second: Sighting) -> Ids:
    """(k, 2) mutual nearest neighbours that pass the ratio test."""
    if len(first.descriptors) < 2 or len(second.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    index, distance = pm.hamming_search(first.descriptors, second.descriptors, k=2)
    rows = np.flatnonzero(distance[:, 0] < RATIO * distance[:, 1])
    target = index[rows, 0]
    back, _ = pm.hamming_search(second.descriptors[target], first.descriptors, k=1)
    mutual = back[:, 0] == rows
    return np.column_stack([rows[mutual], target[mutual]]).astype(np.int64)


def _turned(rotation: Array, first: Array, second: Array, limit: float) -> float:
    """Share of ray pairs that some rotation alone explains.

    The rotation is fitted robustly: from the given one on, least squares over what fits best.
    """
    a = np.column_stack([first, np.ones(len(first))])
    b = np.column_stack([second, np.ones(len(second))])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    for _ in range(5):
        off = np.linalg.norm(a @ rotation.T - b, axis=1)
        near = off <= np.median(off)
        u, _, vt = np.linalg.svd(b[near].T @ a[near])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float((np.linalg.norm(a @ rotation.T - b, axis=1) <= limit).mean())
