"""Linear baselines: real vectors of landmarks, searched by Euclidean distance.

The vectors are descriptors, their means, principal components, or linear discriminants.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import InitVar, dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.baselines.method import Method
from protomark.baselines.support import Moments, Support
from protomark.features.descriptors import InputKind, numbers_of
from protomark.threads import one_blas_thread

# One block of distances takes 2 MB and stays in the cache.
_QUERIES = 256
_VECTORS = 2048

# Chosen on the validation sequence between 1e-4 and 10. With 1e-3 the discriminants are less
# precise than the principal components.
RIDGE = 1.0


@dataclass(eq=False)
class EuclideanMap(Method):
    """Vectors of landmarks: of the numbers of descriptors, or of a linear projection of them."""

    vectors: InitVar[NDArray[Any]]  # (l, k), which times `scale` compare with projected queries
    landmarks: NDArray[np.int64]  # (l,), ascending; several vectors may be of one
    bytes_per_landmark: float
    kind: InputKind = "bits"  # what the descriptors are
    projection: NDArray[np.float32] | None = None  # (width, k), None: the numbers themselves
    offset: NDArray[np.float32] | None = None  # (k,), subtracted from a projected query
    scale: float = 1.0  # size of one step of `vectors`

    def __post_init__(self, vectors: NDArray[Any]) -> None:
        # With |p|^2 / 2 as one more dimension, one product computes |p|^2 / 2 - p.q, which has the
        # order of the distance.
        values = np.asarray(vectors, dtype=np.float32)
        norms = np.einsum("ij,ij->i", values, values)
        self._extended = np.concatenate([values, norms[:, None] / 2], axis=1)
        self.landmarks, self._starts = np.unique(self.landmarks, return_index=True)

    def project(self, descriptors: NDArray[Any]) -> NDArray[np.float32]:
        """Project descriptors (q, b) to (q, k) float32, in steps of the vectors."""
        values = numbers_of(descriptors, self.kind).astype(np.float32)
        if self.projection is not None:
            values = values @ self.projection
        if self.offset is not None:
            values = values - self.offset
        return (values / np.float32(self.scale)).astype(np.float32)

    def match(
        self, descriptors: NDArray[Any], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        queries = self.project(descriptors)
        pieces = [queries[at : at + _QUERIES] for at in range(0, len(queries), _QUERIES)]
        # Threads share pieces rather than BLAS calls, so that selection is parallel, too.
        with one_blas_thread(), ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(self._nearest, pieces))
        rows = np.concatenate([row for row, _ in found] or [np.empty((0, 2), dtype=np.int64)])
        values = np.concatenate([value for _, value in found] or [np.empty((0, 2), np.float32)])
        squared = np.einsum("ij,ij->i", queries, queries)[:, None] + 2 * values
        distances = np.float32(self.scale) * np.sqrt(np.maximum(squared, 0))
        exists = rows >= 0
        return (
            np.where(exists, self.landmarks[rows], -1),
            np.where(exists, distances, np.inf).astype(np.float32),
        )

    def _nearest(
        self, queries: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The two nearest landmarks, -1 if there is none, and |p|^2 / 2 - p.q of their nearest."""
        all_rows = np.arange(len(queries))
        extended = np.concatenate([-queries, np.ones_like(queries[:, :1])], axis=1)
        rows = np.full((len(queries), 2), -1, dtype=np.int64)
        values = np.full((len(queries), 2), np.inf, dtype=np.float32)
        for start, starts, end in self._blocks:
            block = extended @ self._extended[starts[0] : end].T
            if len(starts) < block.shape[1]:
                block = np.minimum.reduceat(block, starts - starts[0], axis=1)
            for _ in range(min(2, block.shape[1])):
                row = block.argmin(axis=1)
                value = block[all_rows, row]
                # Blocks come in order of id, so that ties keep the smaller id.
                first, second = value < values[:, 0], value < values[:, 1]
                for best, new in ((rows, row + start), (values, value)):
                    best[:, 1] = np.where(first, best[:, 0], np.where(second, new, best[:, 1]))
                    best[:, 0] = np.where(first, new, best[:, 0])
                block[all_rows, row] = np.inf
        return rows, values

    @cached_property
    def _blocks(self) -> list[tuple[int, NDArray[np.int64], int]]:
        """About `_VECTORS` vectors each: first landmark, first vector of each, end of the last."""
        ends = np.append(self._starts[1:], len(self._extended))
        blocks, first = [], 0
        while first < len(ends):
            last = int(np.searchsorted(ends, self._starts[first] + _VECTORS, side="right"))
            last = max(last, first + 1)
            blocks.append((first, self._starts[first:last], int(ends[last - 1])))
            first = last
        return blocks


@dataclass(frozen=True)
class Projection:
    """The projection (x - mean) @ matrix, with (width,) mean and (width, k) matrix, float32."""

    mean: NDArray[np.float32]
    matrix: NDArray[np.float32]

    def truncated(self, dim: int) -> Projection:
        """The projection to the first `dim` outputs."""
        return Projection(self.mean, np.ascontiguousarray(self.matrix[:, :dim]))


@lru_cache(maxsize=2)
def principal_components(moments: Moments) -> Projection:
    """All principal components of the descriptors, the largest variance first."""
    _, vectors = np.linalg.eigh(moments.total)
    return _projection(moments, vectors[:, ::-1])


@lru_cache(maxsize=2)
def linear_discriminants(moments: Moments) -> Projection:
    """All linear discriminants, the most discriminative first, in the manner of maplab.

    They are, in the space where differences of matching descriptors are white, the principal
    components of differences of descriptors that do not match (Lynen et al., "Get Out of My Lab",
    RSS 2015, after Bosse and Zlot, 2009). Differences of random pairs have twice the covariance of
    the descriptors, and those within a landmark twice the pooled covariance within landmarks, so
    both follow from `Moments` without drawing pairs. `RIDGE` times the mean variance is added to
    the covariance within.
    """
    ridge = RIDGE * float(np.trace(moments.within)) / len(moments.within)
    # Without any variance within landmarks the ridge alone whitens.
    ridge = ridge if ridge > 0 else 1.0
    variances, axes = np.linalg.eigh(moments.within)
    whiten = axes / np.sqrt(np.maximum(variances, 0) + ridge)
    _, vectors = np.linalg.eigh(whiten.T @ moments.total @ whiten)
    return _projection(moments, whiten @ vectors[:, ::-1])


def projected_mean(support: Support, projection: Projection, *, rounded: bool) -> EuclideanMap:
    """The mean of each landmark's projected descriptors, and one byte for the count.

    With `rounded` the means are int8 with one step for all dimensions, whose largest number is 127;
    queries are not rounded. Otherwise the means are float32.
    """
    means = (support.means - projection.mean) @ projection.matrix
    offset = projection.mean @ projection.matrix
    dim = means.shape[1]
    if not rounded:
        return EuclideanMap(
            means, support.ids, 4 * dim + 1, support.kind, projection.matrix, offset
        )
    step = float(np.abs(means).max()) / 127 or 1.0
    stored = np.rint(means / step).astype(np.int8)
    return EuclideanMap(stored, support.ids, dim + 1, support.kind, projection.matrix, offset, step)


def real_mean(support: Support) -> EuclideanMap:
    """The real-valued mean of all numbers, in float32, and one byte for the count."""
    return EuclideanMap(support.means, support.ids, 4 * support.width + 1, support.kind)


def _projection(moments: Moments, matrix: NDArray[np.float64]) -> Projection:
    return Projection(moments.mean.astype(np.float32), matrix.astype(np.float32))
