"""Protomark itself: the mean of an encoder's codes, as a sealed map answers from it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.methods.method import Method
from protomark.evaluation.support import Support

if TYPE_CHECKING:
    import protomark as pm


class PrototypeMethod(Method):
    """A map of prototypes, open or sealed: k int8 or 4-bit numbers, and one byte for the count."""

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap) -> None:
        self.map = scene
        import protomark as pm

        # An open map searches the int8 prototypes that a sealed one would hold.
        bits = scene.code_bits if isinstance(scene, pm.SealedMap) else 8
        self.bytes_per_landmark = (scene.dim * bits + 7) // 8 + 1

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, distances = self.map.search(descriptors, k=2, threads=threads)
        return ids, distances


def prototypes(
    support: Support, encoder: pm.Encoder, dim: int, threads: int = 1, bits: int = 8
) -> PrototypeMethod:
    """Eq. 1 of Komorowski and Trzcinski: the mean of the codes of each landmark's descriptors.

    Args:
        support: the observations.
        encoder: an encoder for their descriptor.
        dim: dimensions of a prototype, one of `encoder.dims`.
        threads: threads to encode on.
        bits: 8 or 4 bits a number, as a map is sealed.
    """
    import protomark as pm

    scene = pm.PrototypeMap(encoder, dim=dim)
    scene.add(support.landmarks, support.descriptors, threads=threads)
    if bits == 8:
        return PrototypeMethod(scene)
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        # The map stays mapped when its file is gone.
        return PrototypeMethod(scene.seal(Path(folder) / "scene.sealed.pmk", bits=bits))
