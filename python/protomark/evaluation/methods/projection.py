"""Linear projections of the bits: the mean itself, principal components, linear discriminants."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.euclidean_map import EuclideanMap
from protomark.evaluation.support import Moments, Support

# Picked on the validation sequence from 1e-4 to 10. With 1e-3 the discriminants are weaker than the
# principal components.
RIDGE = 1.0


@dataclass(frozen=True)
class Projection:
    """x -> (x - mean) @ matrix, with (bits,) mean and (bits, k) matrix, both float32."""

    mean: NDArray[np.float32]
    matrix: NDArray[np.float32]

    def truncated(self, dim: int) -> Projection:
        """Only the first `dim` outputs."""
        return Projection(self.mean, np.ascontiguousarray(self.matrix[:, :dim]))


@lru_cache(maxsize=2)
def principal_components(moments: Moments) -> Projection:
    """All principal components of the descriptors, the largest variance first."""
    _, vectors = np.linalg.eigh(moments.total)
    return _projection(moments, vectors[:, ::-1])


@lru_cache(maxsize=2)
def linear_discriminants(moments: Moments) -> Projection:
    """All linear discriminants, the most discriminative first, in the manner of maplab.

    Lynen et al., "Get Out of My Lab" (RSS 2015), after Bosse and Zlot (2009): in the space where
    differences of matching descriptors are white, the principal components of differences of
    descriptors that do not match. Differences of random pairs have twice the covariance of the
    descriptors, those within a landmark twice the pooled covariance within landmarks, so both
    follow from `Moments` without drawing pairs. `RIDGE` times the mean variance is added to the
    covariance within.
    """
    ridge = RIDGE * float(np.trace(moments.within)) / len(moments.within)
    # Tracks without any change within a landmark leave nothing to whiten by.
    ridge = ridge if ridge > 0 else 1.0
    variances, axes = np.linalg.eigh(moments.within)
    whiten = axes / np.sqrt(np.maximum(variances, 0) + ridge)
    _, vectors = np.linalg.eigh(whiten.T @ moments.total @ whiten)
    return _projection(moments, whiten @ vectors[:, ::-1])


def projected_mean(support: Support, projection: Projection, *, rounded: bool) -> EuclideanMap:
    """The mean of each landmark's projected descriptors: k bytes and one for the count.

    With `rounded` the means are stored in int8, at one step for all dimensions, such that the
    largest number is 127; queries are not rounded. Without it they are float32.
    """
    means = (support.means - projection.mean) @ projection.matrix
    offset = projection.mean @ projection.matrix
    dim = means.shape[1]
    if not rounded:
        return EuclideanMap(means, support.ids, 4 * dim + 1, projection.matrix, offset)
    step = float(np.abs(means).max()) / 127 or 1.0
    stored = np.rint(means / step).astype(np.int8)
    return EuclideanMap(stored, support.ids, dim + 1, projection.matrix, offset, step)


def mean_of_bits(support: Support) -> EuclideanMap:
    """The real-valued mean of all bits, in float32, and one byte for the count."""
    return EuclideanMap(support.means, support.ids, 4 * support.bits + 1)


def _projection(moments: Moments, matrix: NDArray[np.float64]) -> Projection:
    return Projection(moments.mean.astype(np.float32), matrix.astype(np.float32))
