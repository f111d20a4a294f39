"""Judges given poses by matches that agree on a relative pose, whatever the given ones are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.camera import MAX_PLANE_RAY
from protomark.geometry.pose import relative_pose
from protomark.geometry.triangulation import depth_of_first, epipolar_error

Array = NDArray[np.float64]

# Matches agree on a relative pose within so many pixels of their epipolar lines. If fewer do, or a
# smaller share, they may all be wrong.
_AGREEING_ERROR = 2.0
_MIN_MATCHES = 30
_MIN_SHARE = 0.5
# Given poses fit if, in this share of the pairs, the median error is at most so many pixels.
_MAX_ERROR = 4.0
_MIN_FITTING = 0.7
# Rays that meet at a smaller angle (degrees) do not tell whether they meet behind the cameras.
_CLEAR_ANGLE = 0.5


def agreeing(first: Array, second: Array, focal: float) -> NDArray[np.bool_]:
    """Which matches (n,) agree on a relative pose (PoseLib's LO-RANSAC); none if too few do.

    Rays (n, 2) are NaN where undistortion fails. Those far from the axis do not count.
    """
    found = np.asarray((np.abs(np.hstack([first, second])) < MAX_PLANE_RAY).all(axis=1))
    if found.sum() < _MIN_MATCHES:
        return np.zeros(len(first), bool)
    camera = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0, 0]}
    options = {
        "max_epipolar_error": _AGREEING_ERROR,
        "min_iterations": 50,
        "max_iterations": 1000,
        "seed": 0,
    }
    _, facts = optional("poselib").estimate_relative_pose(
        focal * first[found], focal * second[found], camera, camera, options
    )
    count = int(found.sum())
    found[found] = facts["inliers"]
    enough = found.sum() >= max(_MIN_MATCHES, _MIN_SHARE * count)
    return found if enough else np.zeros(len(first), bool)


def pose_errors(one: Array, other: Array, first: Array, second: Array, focal: float) -> Array:
    """Epipolar errors (n,) of matched rays (n, 2) under poses (3, 4) or (n, 3, 4), pixels.

    Matches that meet behind the cameras are off by the focal length at least.
    """
    relative = relative_pose(one, other)
    depth, angle = depth_of_first(*relative, first, second)
    error = focal * epipolar_error(*relative, first, second)
    behind = (depth < 0) & (angle > np.radians(_CLEAR_ANGLE))
    return np.where(behind, np.maximum(error, focal), error)


def misfit(errors: Sequence[Array]) -> str:
    """A sentence if the errors of each pair of images say that poses are of others, else ""."""
    fitting = sum(float(np.median(error)) <= _MAX_ERROR for error in errors)
    if fitting >= _MIN_FITTING * len(errors):
        return ""
    return (
        f"the poses do not fit the images: in {len(errors) - fitting} of {len(errors)} pairs of "
        f"images, matches lie over {_MAX_ERROR:g} pixels off their epipolar lines or behind the "
        "cameras. Each image needs, under its own name, its pose as in COLMAP (cam_from_world, x "
        "right, y down, z forward): are these camera-to-world, with other axes (OpenGL), or of "
        "other images, or is the camera wrong?"
    )
