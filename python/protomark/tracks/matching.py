"""Matches the descriptors of two keyframes, and verifies the matches by their poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import InputKind
from protomark.features.distances import nearest
from protomark.geometry.pose import pose_at, relative_pose
from protomark.geometry.triangulation import epipolar_error


@dataclass
class View:
    """The data of a keyframe that matching needs."""

    descriptors: NDArray[np.uint8]  # (n, bytes) uint8
    # (n, 2) float64, undistorted, NaN where undistortion fails, see `Camera.local_rays`.
    rays: NDArray[np.float64]
    # (3, 4) float64, cam_from_world; (n, 3, 4), turned for each ray, if the camera is wide.
    pose: NDArray[np.float64]
    focal: float  # focal length in pixels
    kind: InputKind = "bits"  # what descriptors are of


@dataclass
class VerifiedMatches:
    """k matches between two keyframes."""

    # (k, 2) int64, rows of the keypoints in the first and the second keyframe.
    rows: NDArray[np.int64]
    distances: NDArray[np.float32]  # (k,) float32, see `features.distances`
    errors: NDArray[np.float64]  # (k,) float64, epipolar (Sampson) error in pixels

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, keep: NDArray[np.bool_]) -> VerifiedMatches:
        """The matches for which `keep` (k,) is true."""
        return VerifiedMatches(self.rows[keep], self.distances[keep], self.errors[keep])


def _nearest(
    first: NDArray[np.uint8], second: NDArray[np.uint8], ratio: float, kind: InputKind
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Rows (k,) of nearest neighbours that pass the ratio test, and their distances."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
    index, distance = nearest(first, second, 2, kind)
    rows = np.flatnonzero(distance[:, 0] < ratio * distance[:, 1])
    return rows, index[rows, 0], distance[rows, 0]


def _mutual(
    first: NDArray[np.uint8], second: NDArray[np.uint8], rows: NDArray[np.int64], kind: InputKind
) -> NDArray[np.bool_]:
    """Whether the nearest neighbour of each second row is the first of the pair (k, 2)."""
    if not len(rows):
        return np.zeros(0, bool)
    back, _ = nearest(second[rows[:, 1]], first, 1, kind)
    return np.asarray(back[:, 0] == rows[:, 0])


def mutual_matches(
    first: NDArray[np.uint8], second: NDArray[np.uint8], ratio: float, kind: InputKind
) -> NDArray[np.int64]:
    """Rows (k, 2) of mutual nearest neighbours that pass the ratio test."""
    rows = np.column_stack(_nearest(first, second, ratio, kind)[:2])
    return rows[_mutual(first, second, rows, kind)]


def match(first: View, second: View, ratio: float, max_error: float) -> VerifiedMatches:
    """Mutual nearest neighbours that pass the ratio test, within pixels of the epipolar lines."""
    rows, target, distance = _nearest(first.descriptors, second.descriptors, ratio, first.kind)
    error = _epipolar_errors(first, second, rows, target)
    near = error <= max_error  # false for NaN
    matches = VerifiedMatches(np.column_stack([rows, target]), distance, error).where(near)
    return matches.where(_mutual(first.descriptors, second.descriptors, matches.rows, first.kind))


def with_errors(matches: VerifiedMatches, first: View, second: View) -> VerifiedMatches:
    """The same matches with their errors under other poses."""
    return replace(matches, errors=_epipolar_errors(first, second, *matches.rows.T))


def _epipolar_errors(
    first: View, second: View, rows: NDArray[np.int64], target: NDArray[np.int64]
) -> NDArray[np.float64]:
    relative = relative_pose(pose_at(first.pose, rows), pose_at(second.pose, target))
    error = epipolar_error(*relative, first.rays[rows], second.rays[target])
    return error * (0.5 * (first.focal + second.focal))
