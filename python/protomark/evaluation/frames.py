"""Localizes query keyframes by matches with a map, and measures their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.absolute_pose import estimate_pose
from protomark.geometry.camera import Camera
from protomark.geometry.pose import pose_error, transform
from protomark.tracks.file import Tracks

# A pose is found if its error is at most this share of the median scene depth, and this angle.
DEPTH_SHARE = 0.01
DEGREES = 2.0
# RANSAC gets the clearest matches, for this share of a frame's keypoints.
SELECTED_SHARE = 0.25
# Reprojection error of an inlier, and of a right match, as a share of the image's longer side.
PIXEL_SHARE = 0.005


@dataclass(frozen=True)
class QueryFrame:
    """A query keyframe with all its keypoints, with and without landmark."""

    camera: Camera  # its camera
    cam_from_world: NDArray[np.float64]  # (3, 4) float64, its true pose
    keypoints: NDArray[np.float64]  # (n, 2) float64, pixels
    descriptors: NDArray[Any]  # (n, b), those of the tracks
    # (n,) int64, the true landmark of each keypoint, -1 if it is unknown.
    landmarks: NDArray[np.int64]

    @classmethod
    def of(cls, tracks: Tracks, keyframe: int) -> QueryFrame:
        """The keyframe of this index in the tracks."""
        rows = tracks.keypoints_of(keyframe)
        return cls(
            camera=tracks.cameras[int(tracks.keyframe_camera[keyframe])],
            cam_from_world=tracks.cam_from_world[keyframe],
            keypoints=tracks.keypoints[rows].astype(np.float64),
            descriptors=tracks.descriptors[rows],
            landmarks=tracks.landmark_of_keypoint[rows],
        )

    @property
    def max_error(self) -> float:
        """Largest reprojection error of a right match, pixels."""
        return PIXEL_SHARE * max(self.camera.width, self.camera.height)


@dataclass(frozen=True)
class FrameMatches:
    """a selected matches of a frame, the clearest first."""

    keypoints: NDArray[np.int64]  # (a,) int64, row of the keypoint in its frame
    landmarks: NDArray[np.int64]  # (a,) int64


@dataclass(frozen=True)
class LocalizedFrame:
    """The pose of a frame and its error."""

    cam_from_world: NDArray[np.float64] | None  # (3, 4) float64, None if RANSAC found no pose
    position_error: float  # distance of the camera centres, in world units, infinite without a pose
    angle_error: float  # angle between the orientations in degrees, infinite without a pose
    inliers: NDArray[np.bool_]  # (a,) bool, whether each selected match supports the pose

    def found(self, scene_depth: float) -> bool:
        """Whether the pose is within `DEPTH_SHARE` of the depth and `DEGREES`."""
        return self.position_error <= DEPTH_SHARE * scene_depth and self.angle_error <= DEGREES


def select_matches(
    landmarks: NDArray[np.int64], distances: NDArray[np.floating], share: float = SELECTED_SHARE
) -> FrameMatches:
    """Select the clearest matches of a frame.

    Keypoints are ranked by the ratio of the distances to their two nearest landmarks, equal ratios
    by distance, then by order, and a landmark keeps its first keypoint only. The first `share` of
    the frame's keypoints is selected. A threshold on the ratio would favour some methods, as the
    ratios of Hamming and Euclidean distances, and in few and many dimensions, spread differently.

    Args:
        landmarks: (n, 2) int64, two nearest landmarks, -1 where there is none.
        distances: (n, 2) float32.
        share: limit on the selected share of the n keypoints.
    """
    nearest, second = distances[:, 0].astype(np.float64), distances[:, 1].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(second > 0, nearest / second, 1.0)
    order = np.lexsort((nearest, ratio))
    order = order[landmarks[order, 0] >= 0]
    _, best = np.unique(landmarks[order, 0], return_index=True)
    selected = order[np.sort(best)][: int(np.ceil(share * len(landmarks)))]
    return FrameMatches(selected, landmarks[selected, 0])


def right_matches(
    frame: QueryFrame, matches: FrameMatches, positions: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether each match (a,) is with the true landmark, or with one that projects near it.

    `positions` (a, 3) are those of the matches' landmarks.
    """
    labelled = frame.landmarks[matches.keypoints] == matches.landmarks
    pixels = frame.camera.project(transform(frame.cam_from_world, positions))
    error = np.linalg.norm(pixels - frame.keypoints[matches.keypoints], axis=1)
    return labelled | (error <= frame.max_error)


def localize_frame(
    frame: QueryFrame, matches: FrameMatches, positions: NDArray[np.float64]
) -> LocalizedFrame:
    """Localize a frame by selected matches, and compare its pose with the true one.

    `positions` (a, 3) are those of the matches' landmarks.
    """
    pixels = frame.keypoints[matches.keypoints]
    found = estimate_pose(pixels, positions, frame.camera, frame.max_error)
    if found is None:
        return LocalizedFrame(None, np.inf, np.inf, np.zeros(len(positions), dtype=bool))
    pose = found.cam_from_world
    return LocalizedFrame(pose, *pose_error(pose, frame.cam_from_world), found.inliers)


def scene_depth(tracks: Tracks) -> float:
    """Median depth of the landmarks over all observations, in world units."""
    rows = tracks.observations
    positions = tracks.positions_of(tracks.landmark_of_keypoint[rows])
    poses = tracks.cam_from_world[tracks.keyframe_of_keypoint[rows]]
    return float(np.median(np.einsum("nj,nj->n", poses[:, 2, :3], positions) + poses[:, 2, 3]))
