"""Protomark itself: the mean of an encoder's codes, as a sealed map answers from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.method import Method
from protomark.evaluation.support import Support

if TYPE_CHECKING:
    import protomark as pm


class PrototypeMethod(Method):
    """A `pm.PrototypeMap` of the support: k bytes and one for the count."""

    def __init__(self, support: Support, encoder: pm.Encoder, dim: int, threads: int = 1) -> None:
        import protomark as pm

        self.map = pm.PrototypeMap(encoder, dim=dim)
        self.map.add(support.landmarks, support.descriptors, threads=threads)
        self.bytes_per_landmark = dim + 1

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, distances = self.map.search(descriptors, k=2, threads=threads)
        return ids, distances
