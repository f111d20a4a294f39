"""Real-valued methods: one vector a landmark, searched by Euclidean distance."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.method import Method
from protomark.evaluation.support import unpack
from protomark.evaluation.threads import one_blas_thread

# One block of distances, 2 MB, stays in the cache.
_QUERIES = 256
_VECTORS = 2048


class EuclideanMap(Method):
    """Vectors of a linear projection of the bits, one a landmark, ascending by landmark id.

    Args:
        vectors: (l, k) float32 or int8, stored vectors; `vectors * scale` lie where queries do.
        landmarks: (l,) int64, strictly ascending.
        bytes_per_landmark: all that matching needs.
        projection: (bits, k) float32, or None for the bits themselves.
        offset: (k,) float32, subtracted from a projected query.
        scale: size of one step of `vectors`.
    """

    def __init__(
        self,
        vectors: NDArray[Any],
        landmarks: NDArray[np.int64],
        bytes_per_landmark: float,
        projection: NDArray[np.float32] | None = None,
        offset: NDArray[np.float32] | None = None,
        scale: float = 1.0,
    ) -> None:
        self.landmarks = landmarks
        self.bytes_per_landmark = bytes_per_landmark
        self.projection = projection
        self.offset = offset
        self.scale = scale
        # With half of |p|^2 as one more dimension, one product gives |p|^2 / 2 - p.q, which orders
        # as the distance does.
        values = np.asarray(vectors, dtype=np.float32)
        norms = np.einsum("ij,ij->i", values, values)
        self._extended = np.concatenate([values, norms[:, None] / 2], axis=1)

    def project(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(q, bits / 8) uint8 -> (q, k) float32, in steps of the stored vectors."""
        values = unpack(descriptors).astype(np.float32)
        if self.projection is not None:
            values = values @ self.projection
        if self.offset is not None:
            values = values - self.offset
        return (values / np.float32(self.scale)).astype(np.float32)

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        queries = self.project(descriptors)
        pieces = [queries[at : at + _QUERIES] for at in range(0, len(queries), _QUERIES)]
        # Threads over pieces rather than within BLAS: so the selection runs on all of them too.
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
        """Rows of the two nearest vectors, -1 where there is none, and |p|^2 / 2 - p.q of each."""
        every = np.arange(len(queries))
        extended = np.concatenate([-queries, np.ones_like(queries[:, :1])], axis=1)
        rows = np.full((len(queries), 2), -1, dtype=np.int64)
        values = np.full((len(queries), 2), np.inf, dtype=np.float32)
        for start in range(0, len(self._extended), _VECTORS):
            block = extended @ self._extended[start : start + _VECTORS].T
            for _ in range(min(2, block.shape[1])):
                row = block.argmin(axis=1)
                value = block[every, row]
                # Blocks come in order of id, so on a tie what stands already has the smaller one.
                first, second = value < values[:, 0], value < values[:, 1]
                for kept, new in ((rows, row + start), (values, value)):
                    kept[:, 1] = np.where(first, kept[:, 0], np.where(second, new, kept[:, 1]))
                    kept[:, 0] = np.where(first, new, kept[:, 0])
                block[every, row] = np.inf
        return rows, values
