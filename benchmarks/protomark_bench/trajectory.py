"""Measures the error of an estimated trajectory after the best similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """The similarity x' = scale * rotation @ x + shift.

    Attributes:
        scale: factor.
        rotation: (3, 3) float64.
        shift: (3,) float64.
    """

    scale: float
    rotation: Array
    shift: Array

    def __call__(self, points: Array) -> Array:
        """Move points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)


@dataclass(frozen=True)
class TrajectoryError:
    """Absolute trajectory error, in units of the true trajectory, as evo's `evo_ape tum -as`.

    Attributes:
        rmse: root of the mean squared distance of camera centres after alignment.
        mean: mean distance.
        median: median distance.
        largest: largest distance.
        poses: number of poses compared.
        alignment: similarity from the estimated world to the true one.
    """

    rmse: float
    mean: float
    median: float
    largest: float
    poses: int
    alignment: Similarity


def align(source: Array, target: Array) -> Similarity:
    """The similarity that brings source points (n, 3) closest to target points (n, 3).

    It is the least-squares solution of Umeyama, Least-squares estimation of transformation
    parameters between two point patterns (1991), Eq. 40 to 43.

    Raises:
        ValueError: there are fewer than three points, the numbers differ, or all source points
            coincide.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(
            f"trajectories have shapes {source.shape} and {target.shape}: give two of (n, 3)"
        )
    if len(source) < 3:
        raise ValueError(f"{len(source)} poses are common, but alignment needs three")
    middle_a, middle_b = source.mean(0), target.mean(0)
    a, b = source - middle_a, target - middle_b
    variance = float((a * a).sum() / len(a))
    if variance <= 1e-24:
        raise ValueError("all estimated cameras have the same position, so the scale is undefined")
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = u @ np.diag(sign) @ vt
    scale = float((d * sign).sum() / variance)
    return Similarity(scale, rotation, middle_b - scale * rotation @ middle_a)


def trajectory_error(estimated: Array, true: Array) -> TrajectoryError:
    """Absolute trajectory error of camera centres (n, 3) against true ones (n, 3).

    Raises:
        ValueError: as `align`.
    """
    found = align(estimated, true)
    off = np.linalg.norm(found(estimated) - true, axis=1)
    return TrajectoryError(
        rmse=float(np.sqrt((off**2).mean())),
        mean=float(off.mean()),
        median=float(np.median(off)),
        largest=float(off.max()),
        poses=len(off),
        alignment=found,
    )
