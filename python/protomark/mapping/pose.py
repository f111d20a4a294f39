"""The pose of a frame from keypoints and the landmarks that they may see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.localization.absolute_pose import estimate, project
from protomark.tracks.file import Camera

Array = NDArray[np.float64]


def absolute_pose(
    camera: Camera, pixels: Array, points: Array, max_error: float
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Pose by RANSAC and refinement: cam_from_world (3, 4) and the inliers (n,), or None.

    Args:
        camera: the frame's camera.
        pixels: (n, 2), the clearest matches first.
        points: (n, 3) in the world.
        max_error: largest reprojection error of an inlier, pixels.
    """
    found = estimate(np.asarray(pixels, np.float64), points, camera, max_error)
    return None if found is None else (found.cam_from_world, found.inliers)


def refine_pose(
    camera: Camera, pixels: Array, points: Array, pose: Array, max_error: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Least (robust) reprojection error from a pose on: the pose, and the inliers (n,)."""
    import poselib

    if len(pixels) >= 4:
        start = poselib.CameraPose()
        start.Rt = pose
        better, _ = poselib.refine_absolute_pose(
            np.asarray(pixels, np.float64),
            points,
            start,
            camera.as_dict(),
            {"loss_type": "CAUCHY", "loss_scale": 0.5 * max_error, "max_iterations": 20},
        )
        moved = np.asarray(better.Rt, np.float64)
        pose = moved if np.isfinite(moved).all() else pose
    return pose, reprojection_error(camera, pixels, points, pose) <= max_error


def reprojection_error(camera: Camera, pixels: Array, points: Array, pose: Array) -> Array:
    """(n,) pixels, infinite behind the camera."""
    return np.asarray(np.linalg.norm(project(camera, pose, points) - pixels, axis=1))
