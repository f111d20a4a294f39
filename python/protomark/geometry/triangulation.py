"""Two-view and multi-view geometry on undistorted rays (x / z, y / z).

Where a camera is turned for each of its rays (`Camera.local_rays`), each has a pose of its own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.neighbours import runs
from protomark.geometry.pose import rotate

Array = NDArray[np.float64]


def epipolar_error(rotation: Array, translation: Array, first: Array, second: Array) -> Array:
    """Sampson distance (n,) of ray pairs (n, 2), in units of the image plane at z = 1.

    Times the focal length this is in pixels. Two cameras at one position have no epipolar lines:
    then it is the distance to the point that the rotation predicts. The relative pose is one, or
    one for each pair.
    """
    length = np.linalg.norm(translation, axis=-1, keepdims=True)
    moved = rotate(rotation, np.column_stack([first, np.ones(len(first))]))
    b = np.column_stack([second, np.ones(len(second))])
    if not (length >= 1e-12).all():
        out: Array = np.linalg.norm(moved[:, :2] / moved[:, 2:] - second, axis=1)
        return out
    line_b = np.cross(translation / length, moved)
    line_a = rotate(np.swapaxes(rotation, -1, -2), np.cross(b, translation / length))
    gradient = (line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1)
    error: Array = np.abs((b * line_b).sum(1)) / np.sqrt(np.maximum(gradient, 1e-24))
    return error


def depth_of_first(
    rotation: Array, translation: Array, first: Array, second: Array
) -> tuple[Array, Array]:
    """Depth (n,) along z in the first camera, and the angle (n,) between the rays in radians.

    The relative pose is one, or one for each pair.
    """
    a = rotate(rotation, np.column_stack([first, np.ones(len(first))]))
    b = np.column_stack([second, np.ones(len(second))])
    # depth * a + translation is parallel to b: solve the cross product by least squares.
    ab, tb = np.cross(a, b), np.cross(np.broadcast_to(translation, a.shape), b)
    depth = -(ab * tb).sum(1) / np.maximum((ab * ab).sum(1), 1e-24)
    sine = np.linalg.norm(ab, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return depth, np.arcsin(np.clip(sine, 0, 1))


def reprojection_residuals(points: Array, poses: Array, rays: Array) -> tuple[Array, Array]:
    """Differences (n, 2) of projected points (n, 3) from rays (n, 2), and depths (n,)."""
    local = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
    depth = local[:, 2]
    safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    return local[:, :2] / safe[:, None] - rays, depth


def pixel_errors(points: Array, poses: Array, rays: Array, focal: Array | float) -> Array:
    """Reprojection errors (n,) in pixels of the undistorted image, infinite behind the camera.

    Args:
        points: (n, 3) positions.
        poses: (n, 3, 4) cam_from_world.
        rays: (n, 2) undistorted rays.
        focal: (n,) focal lengths in pixels, or one for all.
    """
    difference, depth = reprojection_residuals(points, poses, rays)
    error = np.linalg.norm(difference, axis=1) * focal
    return np.where((depth > 0) & np.isfinite(error), error, np.inf)


def refine_points(
    points: Array,
    landmark: NDArray[np.int64],
    poses: Array,
    seen: Array,
    focal: Array,
    iterations: int = 5,
    huber: float = 1.0,
) -> Array:
    """Move each point to the least (Huber) reprojection error under fixed poses, by Gauss-Newton.

    Args:
        points: (l, 3) positions to start from.
        landmark: (n,) index into points of each observation.
        poses: (n, 3, 4) cam_from_world of each observation.
        seen: (n, 2) undistorted ray of each observation.
        focal: (n,) focal length of each observation, pixels.
        iterations: limit on the steps.
        huber: pixels beyond which an error counts linearly.

    Returns:
        (l, 3) positions; points whose error would grow stay where they are.
    """
    order = np.argsort(landmark, kind="stable")
    poses, seen, focal = poses[order], seen[order], focal[order]
    starts, lengths = runs(landmark[order])
    if not len(starts):
        return points.copy()
    present = landmark[order][starts]
    # The loop has only landmarks with observations, one run of rows each.
    at = points[present]
    run = np.repeat(np.arange(len(present)), lengths)
    # Contiguous columns make the loop faster.
    rotation = np.ascontiguousarray(poses[:, :, :3])
    columns = np.ascontiguousarray(rotation.transpose(1, 2, 0))

    def cost(at: Array) -> tuple[Array, Array, Array, Array, Array]:
        local = np.einsum("nij,nj->ni", rotation, at[run]) + poses[:, :, 3]
        depth = local[:, 2]
        local = local / np.where(depth > 0, depth, 1.0)[:, None]
        difference = (local[:, :2] - seen) * focal[:, None]
        error = np.where(depth > 0, np.hypot(difference[:, 0], difference[:, 1]), 1e6)
        robust = np.where(error < huber, 0.5 * error**2, huber * (error - 0.5 * huber))
        return np.add.reduceat(robust, starts), difference, error, depth, local

    best, difference, error, depth, local = cost(at)
    for _ in range(iterations):
        weight = np.minimum(1.0, huber / np.maximum(error, 1e-12)) * (depth > 0)
        scale = focal / np.where(depth > 0, depth, 1.0)
        x, y = (
            [scale * (columns[k, i] - local[:, k] * columns[2, i]) for i in range(3)]
            for k in (0, 1)
        )
        products = [x[i] * x[j] + y[i] * y[j] for i in range(3) for j in range(i, 3)]
        products += [x[i] * difference[:, 0] + y[i] * difference[:, 1] for i in range(3)]
        sums = np.stack([np.add.reduceat(p * weight, starts) for p in products], axis=1)
        normal = sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        trace = np.trace(normal, axis1=1, axis2=2)
        normal = normal + (1e-6 * trace + 1e-12)[:, None, None] * np.eye(3)
        moved = at - np.linalg.solve(normal, sums[:, 6:, None])[:, :, 0]
        moved = np.where(np.isfinite(moved), moved, at)
        after = cost(moved)
        better = after[0] < best
        # In squared pixels: smaller gains move a projection by less than a thousandth of a pixel.
        if not (best - after[0] > 1e-6).any():
            break
        at = np.where(better[:, None], moved, at)
        best = np.where(better, after[0], best)
        rows = better[run]
        difference, local = (
            np.where(rows[:, None], new, old)
            for new, old in ((after[1], difference), (after[4], local))
        )
        error, depth = np.where(rows, after[2], error), np.where(rows, after[3], depth)
    out = points.copy()
    out[present] = at
    return out


def widest_angle(points: Array, landmark: NDArray[np.int64], centers: Array) -> Array:
    """Largest angle (l,), radians, between two rays to each point.

    Args:
        points: (l, 3) positions.
        landmark: (n,) index into points of each observation, ascending.
        centers: (n, 3) camera centre of each observation.

    The angle is measured from the ray farthest from the first to the ray farthest from that one:
    exact for two rays, at least half the true angle for more.
    """
    count = len(points)
    direction = centers - points[landmark]
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-24)
    angle = np.zeros(count)
    if not len(landmark):
        return angle
    reference = np.zeros((count, 3))
    reference[landmark[::-1]] = direction[::-1]
    for _ in range(2):
        cosine = np.einsum("ni,ni->n", direction, reference[landmark])
        order = np.lexsort((cosine, landmark))
        first = order[np.flatnonzero(np.diff(landmark[order], prepend=-1))]
        np.maximum.at(angle, landmark[first], np.arccos(np.clip(cosine[first], -1, 1)))
        reference[landmark[first]] = direction[first]
    return angle
