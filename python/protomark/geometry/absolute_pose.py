"""Estimates the pose of a camera from keypoints and the landmarks that they observe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.camera import Camera
from protomark.geometry.pose import transform
from protomark.geometry.triangulation import reprojection_residuals

Array = NDArray[np.float64]

MAX_ITERATIONS = 2000
MIN_ITERATIONS = 100

# A camera's focal length is right, roughly right and to be refined, or to be estimated.
FocalLength = Literal["known", "rough", "unknown"]

# Camera models that both COLMAP and PoseLib know.
POSE_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
)

# In refinement, errors count less beyond this share of the largest error, and cost at most this.
_LOSS_SHARE = 0.5
_MAX_LOSS = 20.0
_REFINE_STEPS = 30


@dataclass(frozen=True)
class AbsolutePose:
    """A pose and the matches that agree with it.

    Attributes:
        cam_from_world: (3, 4) float64.
        inliers: (n,) bool.
        camera: the camera, with the estimated focal length if that was not known.
    """

    cam_from_world: Array
    inliers: NDArray[np.bool_]
    camera: Camera


def check_pose_model(camera: Camera) -> None:
    """Raise ValueError unless poses can be estimated for this camera."""
    if camera.model not in POSE_MODELS:
        raise ValueError(
            f"poses cannot be estimated for camera model {camera.model}: undistort the images to "
            f"one of {', '.join(POSE_MODELS)}"
        )
    camera.check_params()
    if camera.params[0] <= 0:
        raise ValueError(f"camera {camera.model} {camera.params} has no valid focal length")


def estimate_pose(
    pixels: Array,
    positions: Array,
    camera: Camera,
    max_error: float,
    focal_length: FocalLength = "known",
) -> AbsolutePose | None:
    """Absolute pose by RANSAC and refinement; None if no four matches agree.

    With a known focal length this is PoseLib's LO-RANSAC with progressive sampling (Chum and Matas,
    PROSAC, CVPR 2005), otherwise COLMAP's, whose refinement moves the focal length, too. Equal
    matches give equal poses.

    Args:
        pixels: (n, 2) float64, keypoints, the likeliest matches first.
        positions: (n, 3) float64, their landmarks in world coordinates.
        camera: the camera; if its focal length is unknown, only principal point and size count.
        max_error: largest reprojection error of an inlier, pixels.
        focal_length: "known", "rough" to have it refined, or "unknown" to have it estimated.

    Raises:
        ValueError: poses cannot be estimated for this camera model.
    """
    check_pose_model(camera)
    if len(positions) < 4:
        return None
    pixels = np.ascontiguousarray(pixels, np.float64)
    if focal_length != "known":
        return _estimate_with_focal_length(
            pixels, positions, camera, max_error, unknown=focal_length == "unknown"
        )
    # PoseLib takes COLMAP's pixels and camera parameters as they are.
    pose, found = optional("poselib").estimate_absolute_pose(
        pixels,
        positions,
        camera.as_dict(),
        {
            "max_reproj_error": max_error,
            "max_iterations": MAX_ITERATIONS,
            "min_iterations": MIN_ITERATIONS,
            "progressive_sampling": True,
            "seed": 0,
        },
        {},
    )
    matrix = np.asarray(pose.Rt, dtype=np.float64)
    if found["num_inliers"] < 4 or not np.isfinite(matrix).all():
        return None
    return AbsolutePose(matrix, np.asarray(found["inliers"], dtype=bool), camera)


def _estimate_with_focal_length(
    pixels: Array, positions: Array, camera: Camera, max_error: float, unknown: bool
) -> AbsolutePose | None:
    from protomark.geometry.colmap import pycolmap, quiet

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = unknown
    estimation.ransac.max_error = max_error
    estimation.ransac.max_num_trials = MAX_ITERATIONS
    estimation.ransac.min_num_trials = MIN_ITERATIONS
    estimation.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = True
    # COLMAP writes the refined parameters into this camera.
    refined = pycolmap.Camera(camera.as_dict())
    with quiet():
        found = pycolmap.estimate_and_refine_absolute_pose(
            pixels, positions, refined, estimation, refinement
        )
    if found is None:
        return None
    matrix = np.asarray(found["cam_from_world"].matrix(), np.float64)
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    params = tuple(float(p) for p in refined.params)
    if not (np.isfinite(matrix).all() and np.isfinite(params).all()) or inliers.sum() < 4:
        return None
    return AbsolutePose(matrix, inliers, replace(camera, params=params))


def refine_pose(
    cam_from_world: Array,
    pixels: Array,
    positions: Array,
    camera: Camera,
    max_error: float,
    weights: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Move a pose to the least (Cauchy) reprojection error by Levenberg-Marquardt, with weights.

    Args:
        cam_from_world: (3, 4) float64, the pose to start from.
        pixels: (n, 2) float64, keypoints.
        positions: (n, 3) float64, their landmarks in world coordinates.
        camera: the camera.
        max_error: largest reprojection error of an inlier, pixels.
        weights: (n,) float64, weights of the squared errors, also of inliers; None: 1.

    Returns:
        The pose (3, 4), and the inliers (n,) bool.
    """
    weights = np.ones(len(pixels)) if weights is None else weights
    pose = cam_from_world
    if len(pixels) >= 4:
        scale = (_LOSS_SHARE * max_error / camera.focal_length) ** 2
        pose = _minimise(pose, positions, camera.rays(pixels), weights, scale)
    error = np.sqrt(weights) * reprojection_error(pose, pixels, positions, camera)
    return pose, error <= max_error


def _minimise(pose: Array, positions: Array, rays: Array, weights: Array, scale: float) -> Array:
    def evaluate(pose: Array) -> tuple[Array, Array, float]:
        poses = np.broadcast_to(pose, (len(positions), 3, 4))
        residual, depth = reprojection_residuals(positions, poses, rays)
        square = np.where(depth > 0, (residual**2).sum(1), np.inf)
        loss = np.minimum(np.log1p(weights * square / scale), _MAX_LOSS)
        return residual, square, float(loss.sum())

    cv2 = optional("cv2")
    pose, damping = np.ascontiguousarray(pose), 1e-4
    residual, square, cost = evaluate(pose)
    for _ in range(_REFINE_STEPS):
        x, y, z = transform(pose, positions).T
        in_front = square < np.inf
        z = np.where(in_front, z, 1.0)
        u, v, zero, one = x / z, y / z, np.zeros_like(z), np.ones_like(z)
        # Derivatives with respect to a small rotation and translation in camera coordinates.
        by_rotation = np.array([[-u * v, one + u * u, -v], [-one - v * v, u * v, u]])
        by_translation = np.array([[one, zero, -u], [zero, one, -v]]) / z
        jacobian = np.concatenate([by_rotation, by_translation], axis=1).transpose(2, 0, 1)
        finite = np.where(in_front, square, 0.0)
        robust = np.where(in_front, weights / (scale + weights * finite), 0.0)
        gradient = np.einsum("n,nij,ni->j", robust, jacobian, residual)
        normal = np.einsum("n,nij,nik->jk", robust, jacobian, jacobian)
        damped = normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(6)
        step = -np.linalg.solve(damped, gradient)
        moved = cv2.Rodrigues(step[:3])[0] @ pose
        moved[:, 3] += step[3:]
        after = evaluate(moved)
        if not after[2] <= cost:
            damping = min(10 * damping, 1e6)
            continue
        converged = cost - after[2] <= 1e-9 * cost
        pose, (residual, square, cost), damping = moved, after, 0.1 * damping
        if converged:
            break
    return pose


def reprojection_error(
    cam_from_world: Array, pixels: Array, positions: Array, camera: Camera
) -> Array:
    """Distance (n,) in pixels of keypoints from projected landmarks, infinite behind the camera."""
    projected = camera.project(transform(cam_from_world, positions))
    return np.asarray(np.linalg.norm(projected - pixels, axis=1))
