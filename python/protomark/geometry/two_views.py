"""Estimates the relative pose of two images of one camera from matches.

PoseLib does so for perspective cameras, and COLMAP for wide ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.absolute_pose import MAX_ITERATIONS, MIN_ITERATIONS
from protomark.geometry.camera import MAX_PLANE_RAY, Camera

Array = NDArray[np.float64]

_SAMPLING = {"min_iterations": MIN_ITERATIONS, "max_iterations": MAX_ITERATIONS, "seed": 0}


def estimate_relative_pose(
    first: Array, second: Array, camera: Camera, max_error: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Relative pose (3, 4) by LO-RANSAC, and which of the matched pixels (n, 2) agree with it."""
    if camera.wide:
        from protomark.geometry.colmap import pycolmap, quiet

        ransac = pycolmap.RANSACOptions()
        ransac.max_error, ransac.random_seed = max_error, 0
        ransac.min_num_trials, ransac.max_num_trials = MIN_ITERATIONS, MAX_ITERATIONS
        model = camera.colmap
        with quiet():
            found = pycolmap.estimate_relative_pose(model, first, model, second, ransac)
        if found is None:
            return np.eye(3, 4), np.zeros(len(first), bool)
        return found["cam2_from_cam1"].matrix(), np.asarray(found["inlier_mask"], bool)
    options, both = {"max_epipolar_error": max_error, **_SAMPLING}, [camera.as_dict()] * 2
    pose, facts = optional("poselib").estimate_relative_pose(first, second, *both, options, {})
    return np.asarray(pose.Rt, np.float64), np.asarray(facts["inliers"], bool)


def planar_poses(
    first: Array, second: Array, camera: Camera, max_error: float, min_inliers: int
) -> list[Array]:
    """Relative poses (3, 4) that matched pixels (n, 2) of a planar scene admit, if it is one."""
    poselib, focal = optional("poselib"), camera.focal_length
    rays = focal * np.hstack([camera.rays(first), camera.rays(second)])
    rays = rays[(np.abs(rays) < focal * MAX_PLANE_RAY).all(1)]
    options = {"max_reproj_error": max_error, **_SAMPLING}
    plane, facts = poselib.estimate_homography(rays[:, :2], rays[:, 2:], options, {})
    if np.asarray(facts["inliers"], bool).sum() < min_inliers:
        return []
    scale = np.diag([focal, focal, 1.0])
    normal = np.linalg.inv(scale) @ np.asarray(plane) @ scale
    return [np.asarray(p.Rt, np.float64) for p in poselib.motion_from_homography(normal)[0]]
