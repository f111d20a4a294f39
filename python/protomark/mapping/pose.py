"""The pose of a frame from keypoints and the landmarks that they may see."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from protomark.localization.absolute_pose import estimate, project
from protomark.tracks.colmap import focal_length, rays
from protomark.tracks.file import Camera
from protomark.tracks.geometry import residuals

Array = NDArray[np.float64]

# An error counts less from this share of the largest on, and so much behind the camera.
_LOSS_SCALE = 0.5
_MOST_LOSS = 20.0
_STEPS = 30


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
    camera: Camera,
    pixels: Array,
    points: Array,
    pose: Array,
    max_error: float,
    weights: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Least (Cauchy) reprojection error from a pose on: the pose, and the inliers (n,).

    Levenberg-Marquardt; PoseLib's refinement takes no weights.

    Args:
        camera: the frame's camera.
        pixels: (n, 2).
        points: (n, 3) in the world.
        pose: (3, 4) cam_from_world.
        max_error: largest reprojection error of an inlier, pixels.
        weights: (n,) how much each squared error counts, for the inliers, too; None: 1.
    """
    share = np.ones(len(pixels)) if weights is None else weights
    if len(pixels) >= 4:
        pose = _least(pose, points, rays(camera, pixels), share, focal_length(camera), max_error)
    error = np.sqrt(share) * reprojection_error(camera, pixels, points, pose)
    return pose, error <= max_error


def _least(
    pose: Array, points: Array, seen: Array, weights: Array, focal: float, max_error: float
) -> Array:
    scale = (_LOSS_SCALE * max_error / focal) ** 2

    def errors(pose: Array) -> tuple[Array, Array, float]:
        difference, depth = residuals(points, np.broadcast_to(pose, (len(points), 3, 4)), seen)
        square = np.where(depth > 0, (difference**2).sum(1), np.inf)
        loss = np.minimum(np.log1p(weights * square / scale), _MOST_LOSS)
        return difference, square, float(loss.sum())

    pose, damping = np.ascontiguousarray(pose), 1e-4
    difference, square, cost = errors(pose)
    for _ in range(_STEPS):
        x, y, z = (points @ pose[:, :3].T + pose[:, 3]).T
        inside = square < np.inf
        z = np.where(inside, z, 1.0)
        u, v, zero, one = x / z, y / z, np.zeros_like(z), np.ones_like(z)
        # Of a small turn, then of a small shift, in the camera's coordinates.
        turn = np.array([[-u * v, one + u * u, -v], [-one - v * v, u * v, u]])
        shift = np.array([[one, zero, -u], [zero, one, -v]]) / z
        jacobian = np.concatenate([turn, shift], axis=1).transpose(2, 0, 1)
        robust = np.where(inside, weights / (scale + weights * np.where(inside, square, 0.0)), 0.0)
        gradient = np.einsum("n,nij,ni->j", robust, jacobian, difference)
        normal = np.einsum("n,nij,nik->jk", robust, jacobian, jacobian)
        damped = normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(6)
        step = -np.linalg.solve(damped, gradient)
        rotation = cv2.Rodrigues(step[:3])[0]
        moved = rotation @ pose
        moved[:, 3] += step[3:]
        after = errors(moved)
        if not after[2] <= cost:
            damping = min(10 * damping, 1e6)
            continue
        done = cost - after[2] <= 1e-9 * cost
        pose, (difference, square, cost), damping = moved, after, 0.1 * damping
        if done:
            break
    return pose


def reprojection_error(camera: Camera, pixels: Array, points: Array, pose: Array) -> Array:
    """(n,) pixels, infinite behind the camera."""
    return np.asarray(np.linalg.norm(project(camera, pose, points) - pixels, axis=1))
