"""Measures the error of an estimated trajectory after the best similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.similarity import Similarity, fit_similarity

Array = NDArray[np.float64]


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


def trajectory_error(estimated: Array, true: Array) -> TrajectoryError:
    """Absolute trajectory error of camera centres (n, 3) against true ones (n, 3).

    Raises:
        ValueError: as `fit_similarity`.
    """
    found = fit_similarity(estimated, true)
    off = np.linalg.norm(found(estimated) - true, axis=1)
    return TrajectoryError(
        rmse=float(np.sqrt((off**2).mean())),
        mean=float(off.mean()),
        median=float(np.median(off)),
        largest=float(off.max()),
        poses=len(off),
        alignment=found,
    )
