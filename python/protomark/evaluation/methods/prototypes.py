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
    """A map of prototypes, open or sealed: k bytes and one for the count."""

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap) -> None:
        self.map = scene
        self.bytes_per_landmark = scene.dim + 1

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, distances = self.map.search(descriptors, k=2, threads=threads)
        return ids, distances


def prototypes(
    support: Support, encoder: pm.Encoder, dim: int, threads: int = 1
) -> PrototypeMethod:
    """Eq. 1 of Komorowski and Trzcinski: the mean of the codes of each landmark's descriptors."""
    import protomark as pm

    scene = pm.PrototypeMap(encoder, dim=dim)
    scene.add(support.landmarks, support.descriptors, threads=threads)
    return PrototypeMethod(scene)
