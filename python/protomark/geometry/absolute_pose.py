"""Estimates the pose of a camera from keypoints and the landmarks that they observe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.geometry.camera import MAX_PLANE_RAY, Camera
from protomark.geometry.pose import transform, turned
from protomark.geometry.triangulation import reprojection_residuals

Array = NDArray[np.float64]

MAX_ITERATIONS = 2000
MIN_ITERATIONS = 100

# A camera's focal length is right, roughly right and to be refined, or to be estimated.
FocalLength = Literal["known", "rough", "unknown"]

# In refinement, errors count less beyond this share of the largest error, and cost at most this.
_LOSS_SHARE = 0.5
_MAX_LOSS = 20.0
_REFINE_STEPS = 30
# Matches that determine the nine numbers of a pose with a free lens.
_MIN_FREE = 6
# Normal equations of a larger condition do not determine a pose.
_MAX_CONDITION = 1e12


@dataclass(frozen=True)
class AbsolutePose:
    """A pose and the matches that agree with it."""

    cam_from_world: Array  # (3, 4) float64
    inliers: NDArray[np.bool_]  # (n,) bool
    camera: Camera  # the camera, with the estimated focal length if that was not known


def estimate_pose(
    pixels: Array,
    positions: Array,
    camera: Camera,
    max_error: float,
    focal_length: FocalLength = "known",
) -> AbsolutePose | None:
    """Absolute pose by RANSAC and refinement; None if no four matches agree.

    With a known focal length this is PoseLib's LO-RANSAC with progressive sampling (Chum and Matas,
    PROSAC, CVPR 2005), otherwise, and for wide cameras, COLMAP's, whose refinement moves the focal
    length, too. Equal matches give equal poses.

    Args:
        pixels: (n, 2) float64, keypoints, the likeliest matches first.
        positions: (n, 3) float64, their landmarks in world coordinates.
        camera: the camera; if its focal length is unknown, only principal point and size count.
        max_error: largest reprojection error of an inlier, pixels.
        focal_length: "known", "rough" to have it refined, or "unknown" to have it estimated; that
            of a wide camera is never unknown.
    """
    if len(positions) < 4:
        return None
    pixels = np.ascontiguousarray(pixels, np.float64)
    if focal_length != "known" or camera.wide:
        return _estimate_by_colmap(pixels, positions, camera, max_error, focal_length)
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


def _estimate_by_colmap(
    pixels: Array, positions: Array, camera: Camera, max_error: float, focal_length: FocalLength
) -> AbsolutePose | None:
    from protomark.geometry.colmap import pycolmap, quiet

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = focal_length == "unknown" and not camera.wide
    estimation.ransac.max_error = max_error
    estimation.ransac.max_num_trials = MAX_ITERATIONS
    estimation.ransac.min_num_trials = MIN_ITERATIONS
    estimation.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = focal_length != "known"
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
    rays, turns = camera.local_rays(pixels)
    found = np.isfinite(rays).all(1)
    if found.sum() >= 4:
        scale = (_LOSS_SHARE * max_error / camera.focal_length) ** 2
        seen = rays[found], None if turns is None else turns[found]
        pose, _ = _minimise(pose, positions[found], seen, weights[found], scale)
    error = np.sqrt(weights) * reprojection_error(pose, pixels, positions, camera)
    return pose, error <= max_error


@dataclass(frozen=True)
class FreeLens:
    """What changes if focal length and principal point may move together with the pose."""

    cam_from_world: Array  # (3, 4) float64, the pose that fits best
    # By how much the mean loss falls, log(1 + (error / s)^2) with half the largest error s.
    gain: float
    spread: float  # standard deviation of the camera centre in world units, infinite if it is open
    stretch: float = 1.0  # the focal length that fits best, by that of the camera
    deviation: float = np.inf  # standard deviation of the stretch, with exact landmarks


def free_lens(
    cam_from_world: Array, pixels: Array, positions: Array, camera: Camera, max_error: float
) -> FreeLens:
    """Refine a pose with focal length and principal point free.

    Args:
        cam_from_world: (3, 4) float64, the pose to start from.
        pixels: (n, 2) float64, keypoints.
        positions: (n, 3) float64, their landmarks in world coordinates.
        camera: the camera to start from.
        max_error: largest reprojection error of an inlier, pixels.
    """
    rays = camera.rays(pixels)
    seen = np.isfinite(rays).all(1) & (transform(cam_from_world, positions)[:, 2] > 0)
    if camera.wide:
        seen &= (np.abs(rays) < MAX_PLANE_RAY).all(1)
    if seen.sum() < _MIN_FREE:
        return FreeLens(cam_from_world, 0.0, np.inf)
    rays, positions = rays[seen], positions[seen]
    scale = (_LOSS_SHARE * max_error / camera.focal_length) ** 2
    weights, fixed = np.ones(len(rays)), np.array([1.0, 0.0, 0.0])

    def square(pose: Array, lens: Array) -> Array:
        x, y, z = transform(pose, positions).T
        z = np.where(z > 0, z, np.nan)
        error = lens[0] * np.stack([x / z, y / z], 1) + lens[1:] - rays
        return np.nan_to_num((error**2).sum(1), nan=np.inf)

    pose, lens = _minimise(cam_from_world, positions, (rays, None), weights, scale, fixed)
    before, after = square(cam_from_world, fixed), square(pose, lens)
    losses = [np.minimum(np.log1p(s / scale), _MAX_LOSS).mean() for s in (before, after)]
    inlier = after <= scale / _LOSS_SHARE**2
    count, spread, deviation = int(inlier.sum()), np.inf, np.inf
    if count >= _MIN_FREE:
        x, y, z = transform(pose, positions[inlier]).T
        projected = np.stack([x / z, y / z], 1)
        jacobian = np.concatenate(
            [
                lens[0] * _jacobian(pose, positions[inlier], np.ones(count, bool)),
                _lens_jacobian(projected),
            ],
            axis=2,
        )
        covariance = _covariance(jacobian, float(after[inlier].sum()))
        if covariance is not None:
            spread = float(np.sqrt(np.trace(covariance[3:6, 3:6])))
            deviation = float(np.sqrt(covariance[6, 6]))
    return FreeLens(pose, float(losses[0] - losses[1]), spread, float(lens[0]), deviation)


def _minimise(
    pose: Array,
    positions: Array,
    seen: tuple[Array, Array | None],
    weights: Array,
    scale: float,
    lens: Array | None = None,
) -> tuple[Array, Array]:
    """Returns pose and lens: by how much rays are stretched, and shifted along x and y.

    What is seen are `Camera.local_rays`. The lens moves only if it is given.
    """
    free = lens is not None
    rays, turns = seen

    def evaluate(pose: Array, lens: Array) -> tuple[Array, Array, float]:
        x, y, depth = transform(turned(pose, turns), positions).T
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        residual = lens[0] * np.stack([x / safe, y / safe], 1) + lens[1:] - rays
        square = np.where(depth > 0, (residual**2).sum(1), np.inf)
        loss = np.minimum(np.log1p(weights * square / scale), _MAX_LOSS)
        return residual, square, float(loss.sum())

    cv2 = optional("cv2")
    pose, damping = np.ascontiguousarray(pose), 1e-4
    lens = np.array([1.0, 0.0, 0.0]) if lens is None else lens
    residual, square, cost = evaluate(pose, lens)
    for _ in range(_REFINE_STEPS):
        in_front = square < np.inf
        jacobian = lens[0] * _jacobian(pose, positions, in_front, turns)
        if free:
            projected = (residual + rays - lens[1:]) / lens[0]
            jacobian = np.concatenate([jacobian, _lens_jacobian(projected)], axis=2)
        finite = np.where(in_front, square, 0.0)
        robust = np.where(in_front, weights / (scale + weights * finite), 0.0)
        gradient = np.einsum("n,nij,ni->j", robust, jacobian, residual)
        normal = np.einsum("n,nij,nik->jk", robust, jacobian, jacobian)
        damped = normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(normal))
        step = -np.linalg.solve(damped, gradient)
        moved = cv2.Rodrigues(step[:3])[0] @ pose
        moved[:, 3] += step[3:6]
        stretched = lens + step[6:] if free else lens
        after = evaluate(moved, stretched)
        if not after[2] <= cost or stretched[0] <= 0:
            damping = min(10 * damping, 1e6)
            continue
        converged = cost - after[2] <= 1e-9 * cost
        pose, lens, (residual, square, cost) = moved, stretched, after
        damping = max(0.1 * damping, 1e-9)
        if converged:
            break
    return pose, lens


def _lens_jacobian(projected: Array) -> Array:
    """Derivatives (n, 2, 3) of rays by their stretch and shift."""
    shift = np.broadcast_to(np.eye(2), (len(projected), 2, 2))
    return np.concatenate([projected[:, :, None], shift], axis=2)


def _jacobian(
    pose: Array, positions: Array, in_front: NDArray[np.bool_], turns: Array | None = None
) -> Array:
    """Derivatives (n, 2, 6) of rays by a small rotation, then a small translation of the camera."""
    x, y, z = transform(turned(pose, turns), positions).T
    z = np.where(in_front, z, 1.0)
    u, v, zero, one = x / z, y / z, np.zeros_like(z), np.ones_like(z)
    by_rotation = np.array([[-u * v, one + u * u, -v], [-one - v * v, u * v, u]])
    by_translation = np.array([[one, zero, -u], [zero, one, -v]]) / z
    jacobian = np.concatenate([by_rotation, by_translation], axis=1).transpose(2, 0, 1)
    if turns is None:
        return jacobian
    return np.concatenate([jacobian[:, :, :3] @ turns, jacobian[:, :, 3:] @ turns], axis=2)


def pose_covariance(
    cam_from_world: Array, pixels: Array, positions: Array, camera: Camera
) -> Array | None:
    """How uncertain a refined pose is: s^2 (J^T J)^-1 over its inliers.

    s^2 is the mean square of their residuals, per degree of freedom (Hartley and Zisserman,
    Multiple View Geometry, 5.2). Landmarks and camera count as exact.

    Args:
        cam_from_world: (3, 4) float64, the refined pose.
        pixels: (n, 2) float64, the inliers.
        positions: (n, 3) float64, their landmarks in the world.
        camera: the camera.

    Returns:
        (6, 6) float64 of (rotation, translation), as COLMAP has it: a small rotation vector in
        radians that is applied after the pose, in camera coordinates, and the translation of
        `cam_from_world` in world units. None for fewer than four inliers, or if they leave a
        direction open.
    """
    rays, turns = camera.local_rays(pixels)
    if not np.isfinite(rays).all():
        found = np.isfinite(rays).all(1)
        return pose_covariance(cam_from_world, pixels[found], positions[found], camera)
    if len(pixels) < 4:
        return None
    poses = np.broadcast_to(turned(cam_from_world, turns), (len(positions), 3, 4))
    residual, depth = reprojection_residuals(positions, poses, rays)
    jacobian = _jacobian(cam_from_world, positions, depth > 0, turns)
    return _covariance(jacobian, float((residual**2).sum()))


def _covariance(jacobian: Array, square: float) -> Array | None:
    """s^2 (J^T J)^-1 of derivatives (n, 2, d) and the sum of squared residuals; None if open."""
    jacobian = jacobian.reshape(-1, jacobian.shape[2])
    variance = square / (len(jacobian) - jacobian.shape[1])
    # Rotations and translations differ in unit: without scales their condition means nothing.
    scale = np.linalg.norm(jacobian, axis=0)
    if not (np.isfinite(variance) and (scale > 0).all()):
        return None
    normal = (jacobian / scale).T @ (jacobian / scale)
    if np.linalg.cond(normal) > _MAX_CONDITION:
        return None
    return np.asarray(variance * np.linalg.inv(normal) / np.outer(scale, scale))


def reprojection_error(
    cam_from_world: Array, pixels: Array, positions: Array, camera: Camera
) -> Array:
    """Distance (n,) in pixels of keypoints from projected landmarks, infinite behind the camera."""
    projected = camera.project(transform(cam_from_world, positions))
    return np.asarray(np.linalg.norm(projected - pixels, axis=1))
