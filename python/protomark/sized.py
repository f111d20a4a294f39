"""A keypoint's size as further bits of its descriptor, for places seen from like distances again.

Binary descriptors are sampled at the keypoint's size so that they do not change with the distance.
Where a camera sees a landmark from about the same distance again, the size comes back, too, and it
tells landmarks apart. Unlike the angle it does not mind a camera that rolls. This is future work
that Komorowski and Trzcinski name. Encoders `<descriptor>-sized` take such longer descriptors; both
the map and the queries must be made with them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from protomark.tracks.file import Tracks

SUFFIX = "-sized"
BYTES = 4
STEPS = 32  # a quarter octave each, from 6 pixels on
_LEAST = 6.0
_REACH = 2  # neighbours set too, so that near values share bits


def size_bits(sizes: ArrayLike) -> NDArray[np.uint8]:
    """(n, 32) uint8 of 0 and 1: the quarter octave of each of n sizes, and two on either side.

    Sizes are pixels as OpenCV's KeyPoint.size, from 6 pixels on; not positive or NaN: unknown, no
    bit is set.
    """
    size = np.asarray(sizes, np.float64)
    bits = np.zeros((len(size), STEPS), np.uint8)
    rows = np.flatnonzero(np.isfinite(size) & (size > 0))
    octaves = np.log2(np.maximum(size[rows], 1.0) / _LEAST)
    own = np.clip(np.floor(4 * octaves), 0, STEPS - 1).astype(np.int64)
    for step in range(-_REACH, _REACH + 1):
        inside = (own + step >= 0) & (own + step < STEPS)
        bits[rows[inside], own[inside] + step] = 1
    return bits


def sized_descriptors(descriptors: NDArray[np.uint8], sizes: ArrayLike) -> NDArray[np.uint8]:
    """Descriptors with 32 more bits that say the keypoint's size.

    Args:
        descriptors: (n, B) uint8.
        sizes: (n,) pixels as OpenCV's KeyPoint.size; not positive or NaN: unknown, no bit is set.

    Returns:
        (n, B + 4) uint8: the descriptor, then `size_bits`, low bit first.

    Raises:
        ValueError: the lengths differ.
    """
    descriptors = np.ascontiguousarray(descriptors, np.uint8)
    size = np.asarray(sizes, np.float64)
    if descriptors.ndim != 2 or size.shape != (len(descriptors),):
        raise ValueError(
            f"descriptors {descriptors.shape} and sizes {size.shape} do not fit together: "
            "give (n, bytes) and (n,)"
        )
    return np.hstack([descriptors, np.packbits(size_bits(size), axis=1, bitorder="little")])


def sized_tracks(tracks: Tracks) -> Tracks:
    """The tracks with such descriptors, named `<descriptor>-sized`.

    Raises:
        ValueError: the keypoints have no sizes, or all the same one.
    """
    if len(tracks.sizes) and (tracks.sizes == tracks.sizes[0]).all():
        raise ValueError(
            f"all keypoints of these {tracks.descriptor} tracks have the same size; the sized "
            "encoders need those that the detector gives"
        )
    return replace(
        tracks,
        descriptor=tracks.descriptor + SUFFIX,
        descriptors=sized_descriptors(tracks.descriptors, tracks.sizes),
    )
