"""The binary descriptors that OpenCV computes, and their bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DescriptorKind:
    """A descriptor; docs/tracks.md names the detector that it is used with."""

    name: str  # on the command line and in files
    bytes: int  # length of a descriptor

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * self.bytes


_BYTES = {"freak": 64, "orb": 32, "brisk": 64, "akaze": 61, "latch": 32, "beblid": 64, "teblid": 32}
DESCRIPTORS = {name: DescriptorKind(name, size) for name, size in _BYTES.items()}


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
