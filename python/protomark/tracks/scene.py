"""The keypoints of a sequence while their landmarks are being determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.colmap import ColmapModel
from protomark.geometry.pose import turned
from protomark.geometry.triangulation import pixel_errors


@dataclass
class Scene:
    """All keypoints of all keyframes, and their landmarks."""

    model: ColmapModel  # cameras and m poses
    offsets: NDArray[np.int64]  # (m + 1,) int64, rows of each keyframe
    keyframe: NDArray[np.int64]  # (n,) int64, keyframe of each keypoint
    keypoints: NDArray[np.float32]  # (n, 2) float32, pixels
    rays: NDArray[np.float64]  # (n, 2) float64, undistorted, NaN where undistortion fails
    focal: NDArray[np.float64]  # (n,) float64, focal length in pixels
    descriptors: NDArray[np.uint8]  # (n, bytes) uint8
    labels: NDArray[np.int64]  # (n,) int64, row of the landmark in positions, -1 for none
    positions: NDArray[np.float64]  # (l, 3) float64
    turns: NDArray[np.float64] | None = None  # (n, 3, 3) float64, see `Camera.local_rays`

    def observations(self) -> NDArray[np.int64]:
        """Rows with a landmark, sorted by landmark, then by row."""
        rows = np.flatnonzero(self.labels >= 0)
        return rows[np.argsort(self.labels[rows], kind="stable")]

    def rows_of(
        self, landmarks: NDArray[np.int64], rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Those of the observations `rows` that are of landmarks (n,), and their numbers (n,)."""
        labels = self.labels[rows]
        start = np.searchsorted(labels, landmarks, "left")
        length = np.searchsorted(labels, landmarks, "right") - start
        shift = np.repeat(start - np.cumsum(length) + length, length)
        return rows[np.arange(len(shift)) + shift], length

    def poses(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Poses (n, 3, 4) that the rays of keypoints count from."""
        poses = self.model.cam_from_world[self.keyframe[rows]]
        return turned(poses, None if self.turns is None else self.turns[rows])

    def errors(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Reprojection errors (n,) of observations in pixels of the undistorted image."""
        return pixel_errors(
            self.positions[self.labels[rows]],
            self.poses(rows),
            self.rays[rows],
            self.focal[rows],
        )
