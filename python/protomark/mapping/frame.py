"""Frames of the input: images, and their keypoints before and after they are registered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Features
from protomark.geometry.camera import Camera
from protomark.geometry.pose import rotate, turned

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


@dataclass
class InputImage:
    """One image of the input."""

    index: int  # index in its input, from 0
    name: str  # name, unique in the map
    time: float  # seconds, or the index if the input has no times
    image: NDArray[np.uint8] | None  # (height, width) uint8, None if it cannot be read
    pose: Array | None = None  # (3, 4) given pose, or None
    camera: Camera | None = None  # its camera, or None: that of the others
    problem: str = ""  # why there is no image, else ""
    features: Features | None = None  # its features, if they are known already


@dataclass
class Frame:
    """Keypoints and descriptors of an image, and once it is registered its pose and landmarks."""

    index: int  # index in its input, from 0
    name: str  # image name, unique in the map
    time: float  # seconds, or the index if the input has no times
    camera_id: int  # its camera
    # (n, 2) float32, pixels; those without a landmark are dropped when the frame leaves the window.
    keypoints: NDArray[np.float32]
    rays: Array  # (n, 2) float64, undistorted, see `Camera.local_rays`
    # (n,) float64, standard deviation of the keypoints in pixels, which grows with their size.
    sigma: Array
    descriptors: NDArray[np.uint8] | None = None  # (n, B) uint8, None outside of the window
    # (n, width), the form that the memory compares. Outside of the window only the seal reads it,
    # to tune prototypes by what observed them.
    encoded: NDArray[Any] | None = None
    # (3, 4) float64, cam_from_world; NaN before the frame is registered.
    pose: Array = field(default_factory=lambda: np.full((3, 4), np.nan))
    # (n,) int64, the landmark that each keypoint observes, -1 for none.
    landmarks: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    keyframe: bool = True  # whether its observations take part in bundle adjustment
    turns: Array | None = None  # (n, 3, 3) float64, see `Camera.local_rays`

    def at(self, pose: Array) -> Frame:
        """A copy with a pose and without landmarks, to register in a map."""
        landmarks = np.full(len(self.keypoints), -1, np.int64)
        return replace(self, pose=np.ascontiguousarray(pose), landmarks=landmarks)

    def local_poses(self, rows: Ids) -> Array:
        """Poses (k, 3, 4) that the rays of these keypoints count from; (3, 4) if all are one."""
        return turned(self.pose, None if self.turns is None else self.turns[rows])

    def points(self, rows: Ids, depth: Array) -> Array:
        """World coordinates (k, 3) of points that keypoints see so far (k,) away along z."""
        poses = self.local_poses(rows)
        local = np.column_stack([self.rays[rows], np.ones(len(rows))]) * depth[:, None]
        return rotate(np.swapaxes(poses[..., :3], -1, -2), local - poses[..., 3])

    def directions(self, rows: Ids) -> Array:
        """Unit vectors (k, 3) of keypoints in camera coordinates."""
        directions = self.at(np.eye(3, 4)).points(rows, np.ones(len(rows)))
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    @property
    def observed(self) -> Ids:
        """Rows of the keypoints that observe a landmark."""
        return np.flatnonzero(self.landmarks >= 0)

    @property
    def seen(self) -> Ids:
        """Landmarks that the keypoints observe."""
        return self.landmarks[self.landmarks >= 0]

    @property
    def codes(self) -> NDArray[Any]:
        """The encoded descriptors of a frame in the window."""
        if not self.in_window or self.encoded is None:
            raise ValueError(f"{self.name}: the frame has left the window and has no descriptors")
        return self.encoded

    @property
    def in_window(self) -> bool:
        """Whether the frame still has its descriptors."""
        return self.descriptors is not None

    def leave_window(self) -> None:
        """Drop the descriptors, and the keypoints that observe no landmark."""
        rows = self.observed
        for name in ("keypoints", "rays", "sigma", "landmarks"):
            setattr(self, name, getattr(self, name)[rows])
        self.turns = None if self.turns is None else self.turns[rows]
        self.encoded = None if self.encoded is None else self.encoded[rows]
        self.descriptors = None


def keypoint_sigma(sizes: NDArray[np.float32]) -> Array:
    """Standard deviations (n,) of keypoints with these sizes, 1 for the smallest of an image.

    They grow like the size in sharp images, and less where blur hides the finest scales.
    """
    return np.sqrt(sizes.astype(np.float64) / sizes.min(initial=np.inf))
