"""The descriptors that images are described by, and the numbers that they are of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# Bits in bytes, lowest first, or vectors of numbers of this type.
InputKind = Literal["bits", "uint8", "float32"]
# Numbers that a vector may have.
VECTOR_SIZES = range(16, 1025)


@dataclass(frozen=True)
class DescriptorKind:
    """A descriptor; docs/tracks.md names the detector that it is used with."""

    name: str  # on the command line and in files
    bytes: int  # length of a descriptor
    input: InputKind = "bits"  # what its bytes are

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * self.bytes


_BYTES = {"freak": 64, "orb": 32, "brisk": 64, "akaze": 61, "latch": 32, "beblid": 64, "teblid": 32}
DESCRIPTORS = {name: DescriptorKind(name, size) for name, size in _BYTES.items()}
# RootSIFT as COLMAP stores it: 512 times the root of the share of each of 128 numbers in their sum.
DESCRIPTORS["sift"] = DescriptorKind("sift", 128, "uint8")


def descriptor_kind(name: str) -> DescriptorKind:
    """The descriptor of this name.

    Raises:
        ValueError: there is no such descriptor.
    """
    try:
        return DESCRIPTORS[name.lower()]
    except KeyError:
        raise ValueError(
            f"{name} is not a descriptor of OpenCV: choose one of {', '.join(DESCRIPTORS)}"
        ) from None


def unpack_bits(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(n, B) uint8 -> (n, 8 B) uint8 of 0 and 1: bit i is bit i % 8 of byte i / 8, lowest first."""
    return np.unpackbits(descriptors, axis=1, bitorder="little")


def numbers_of(descriptors: NDArray[Any], kind: InputKind) -> NDArray[Any]:
    """The numbers (n, d) of descriptors: bits as uint8 of 0 and 1, or vectors as they are."""
    return unpack_bits(descriptors) if kind == "bits" else descriptors
