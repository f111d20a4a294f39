"""Binary methods: one or more packed descriptors a landmark, searched by Hamming distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.method import Method


class HammingMap(Method):
    """Descriptors, each of a landmark, sorted by landmark id."""

    def __init__(
        self,
        descriptors: NDArray[np.uint8],
        landmarks: NDArray[np.int64],
        bytes_per_landmark: float,
    ) -> None:
        self.descriptors = np.ascontiguousarray(descriptors)
        self.landmarks = landmarks
        self.bytes_per_landmark = bytes_per_landmark

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        import protomark as pm

        landmarks, distances = pm.hamming_search(
            descriptors, self.descriptors, k=2, landmarks=self.landmarks, threads=threads
        )
        return landmarks, np.where(landmarks >= 0, distances, np.inf).astype(np.float32)
