"""Poses: rigid motions as (3, 4) float64 `cam_from_world` matrices, COLMAP's convention."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def transform(cam_from_world: Array, points: Array) -> Array:
    """Points (n, 3) in coordinates of one camera (3, 4), or each of its own (n, 3, 4)."""
    return rotate(cam_from_world[..., :3], points) + cam_from_world[..., 3]


def compose(second: Array, first: Array) -> Array:
    """The pose (3, 4) of the first motion and then the second."""
    return np.column_stack(
        [second[:, :3] @ first[:, :3], second[:, :3] @ first[:, 3] + second[:, 3]]
    )


def inverse(pose: Array) -> Array:
    """The pose (3, 4) that undoes a pose (3, 4)."""
    return np.column_stack([pose[:, :3].T, camera_centers(pose)])


def camera_centers(cam_from_world: Array) -> Array:
    """Camera centres (..., 3) in world coordinates, of poses (..., 3, 4)."""
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    return np.asarray(-np.einsum("...ji,...j->...i", rotation, translation))


def turned(pose: Array, turns: Array | None) -> Array:
    """Poses (n, 3, 4) of a camera after each of the turns (n, 3, 3); None: the pose (3, 4)."""
    return pose if turns is None else np.asarray(turns @ pose)


def pose_at(pose: Array, rows: NDArray[Any]) -> Array:
    """The poses in these rows of (n, 3, 4); a pose (3, 4) is that of every row."""
    return pose if pose.ndim == 2 else pose[rows]


def rotate(rotation: Array, vectors: Array) -> Array:
    """Vectors (n, 3) after one rotation (3, 3), or each after its own (n, 3, 3)."""
    if rotation.ndim == 2:
        return np.asarray(vectors @ rotation.T)
    return np.asarray(np.einsum("nij,nj->ni", rotation, vectors))


def relative_pose(first: Array, second: Array) -> tuple[Array, Array]:
    """Rotation (..., 3, 3) and translation (..., 3) from the first to the second camera.

    Poses are (3, 4) or (n, 3, 4).
    """
    rotation = second[..., :3] @ np.swapaxes(first[..., :3], -1, -2)
    return rotation, second[..., 3] - (rotation @ first[..., 3:])[..., 0]


def pose_error(estimate: Array, true: Array) -> tuple[float, float]:
    """Distance of the camera centres in world units, and angle between the poses in degrees."""
    distance = np.linalg.norm(camera_centers(estimate) - camera_centers(true))
    # Unlike arccos of the trace, the distance of the matrices is accurate for small angles.
    chord = np.linalg.norm(estimate[:, :3] - true[:, :3]) / np.sqrt(8)
    return float(distance), float(np.degrees(2 * np.arcsin(min(chord, 1.0))))


def ground_plane(poses: Array) -> Array:
    """Axes (2, 3) of the ground plane, x along the widest spread of cameras, from poses (n, 3, 4).

    The up direction is the mean of the images' up directions. Cameras that mostly look one way, and
    move less along it than along up, look down: then up is the opposite of their view.
    """
    centers = camera_centers(poses)
    spread = centers - centers.mean(axis=0)
    up, back = -poses[:, 1, :3].mean(axis=0), -poses[:, 2, :3].mean(axis=0)
    if np.linalg.norm(back) > 0.7 and np.linalg.norm(spread @ back) < np.linalg.norm(spread @ up):
        up = back
    up = up / (np.linalg.norm(up) or 1.0)
    spread = spread - np.outer(spread @ up, up)
    # Without any spread the first right-singular vector is arbitrary and may contain `up`.
    across = np.linalg.svd(spread, full_matrices=False)[2][0]
    across = across - (across @ up) * up
    if np.linalg.norm(across) < 1e-9:
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(up, across)])


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) w, x, y, z.

    Raises:
        ValueError: the length of a quaternion is not 1 (within 5 %).
    """
    norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    unlike = ~(np.abs(norm - 1) <= 0.05)[..., 0]
    if unlike.any():
        first = np.asarray(quaternion)[unlike][0].tolist()
        raise ValueError(f"the length of quaternion {first} is not 1")
    w, x, y, z = np.moveaxis(quaternion / norm, -1, 0)
    zero = np.zeros_like(w)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    cross = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(np.eye(3) + 2 * w[..., None, None] * cross + 2 * cross @ cross)


def quaternion_from_rotation(rotation: Array) -> Array:
    """Quaternion w, x, y, z with w >= 0 of a rotation matrix (3, 3).

    This is the eigenvector of Bar-Itzhack (2000), which is well conditioned for every rotation.
    """
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0, 0, 0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0, 0],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0],
            [
                r[1, 0] - r[0, 1],
                r[2, 0] + r[0, 2],
                r[2, 1] + r[1, 2],
                r[2, 2] - r[0, 0] - r[1, 1],
            ],
        ]
    )
    _, vectors = np.linalg.eigh(k)  # reads the lower triangle
    q = vectors[:, -1]
    return np.asarray(q if q[0] >= 0 else -q)
