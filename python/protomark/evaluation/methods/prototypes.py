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
    """A map of prototypes, open or sealed.

    A prototype has k int8 or 4-bit numbers. A landmark has one byte for the count, and where
    landmarks have several prototypes one more that says how many.
    """

    def __init__(self, scene: pm.PrototypeMap | pm.SealedMap) -> None:
        from protomark.info import matching_bytes

        self.map = scene
        # An open map searches the int8 prototypes that a sealed one would hold.
        self.bytes_per_landmark = matching_bytes(scene)

    def match(
        self, descriptors: NDArray[np.uint8], threads: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See `Method.match`."""
        ids, squared = self.map.search(descriptors, k=2, threads=threads)
        return ids, np.where(ids >= 0, np.sqrt(squared.astype(np.float32)), np.float32(np.inf))


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


def prototypes_in(size: float, dim: int) -> float:
    """How many 4-bit prototypes of `dim` numbers a landmark has in `size` bytes.

    dim / 2 bytes a prototype; one for the count, one for the number of prototypes.
    """
    return (size - 2) / (dim / 2)


def looks(
    support: Support,
    encoder: pm.Encoder,
    dim: int,
    look_bits: int,
    most_bytes: float,
    threads: int = 1,
) -> PrototypeMethod:
    """A prototype of 4 bits a number for each look of a landmark, in a number of bytes.

    Args:
        support: the observations.
        encoder: an encoder for their descriptor.
        dim: dimensions of a prototype, an even one of `encoder.dims`.
        look_bits: signs of a code that tell looks apart.
        most_bytes: bytes that a landmark takes on average, at most.
        threads: threads to encode on.
    """
    import protomark as pm

    scene = pm.PrototypeMap(encoder, dim=dim, look_bits=look_bits)
    scene.add(support.landmarks, support.descriptors, threads=threads)
    mean_prototypes = prototypes_in(most_bytes, dim)
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        path = Path(folder) / "scene.sealed.pmk"
        return PrototypeMethod(scene.seal(path, bits=4, prototypes=mean_prototypes))
