"""The binary descriptors that OpenCV computes, with their detectors, and their bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DescriptorKind:
    """A descriptor and the detector that it is commonly used with."""

    name: str  # name on the command line and in files, such as "freak"
    bytes: int  # length of a descriptor in bytes
    detector: str  # the detector of its keypoints

    @property
    def bits(self) -> int:
        """Length of a descriptor in bits."""
        return 8 * self.bytes


DESCRIPTORS = {
    kind.name: kind
    for kind in (
        DescriptorKind("freak", 64, "BRISK (multi-scale AGAST)"),
        DescriptorKind("orb", 32, "ORB (oriented FAST)"),
        DescriptorKind("brisk", 64, "BRISK (multi-scale AGAST)"),
        DescriptorKind("akaze", 61, "AKAZE"),
        DescriptorKind("latch", 32, "ORB (oriented FAST)"),
        DescriptorKind("beblid", 64, "ORB (oriented FAST)"),
        DescriptorKind("teblid", 32, "ORB (oriented FAST)"),
    )
}


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
