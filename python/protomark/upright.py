"""A keypoint's angle and size as further bits of its descriptor, for cameras that stay upright.

Binary descriptors are turned by the keypoint's angle so that they do not change as the camera
rolls. A camera that does not roll (on a car, a robot, a headset, a phone held as usual) sees a
landmark's angle again and again, and it tells landmarks apart; how large the keypoint is does so
too. This is the future work that Komorowski and Trzcinski name. Encoders `<descriptor>-upright`
take such longer descriptors. Both the map and the queries must be made with them, and where the
camera rolls (a drone that comes back the other way) the plain encoder is better.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protomark.sized import STEPS as _SIZES
from protomark.sized import size_bits

if TYPE_CHECKING:
    from protomark.tracks.file import Tracks

SUFFIX = "-upright"
BYTES = 8
_ANGLES = 32  # of the full turn
_REACH = 3  # neighbours set too, so that near values share bits


def upright_descriptors(
    descriptors: NDArray[np.uint8], angles: ArrayLike, sizes: ArrayLike
) -> NDArray[np.uint8]:
    """Descriptors with 64 more bits that say the keypoint's angle and size.

    Args:
        descriptors: (n, B) uint8.
        angles: (n,) degrees as OpenCV's KeyPoint.angle; negative or NaN: unknown, no bit is set.
        sizes: (n,) pixels as OpenCV's KeyPoint.size; not positive or NaN: unknown.

    Returns:
        (n, B + 8) uint8: the descriptor, then 32 bits for the angle (in steps of 11.25 degrees,
        the keypoint's own and three on either side set) and 32 for the size (in steps of a quarter
        octave from 6 pixels on, its own and two on either side set).

    Raises:
        ValueError: the lengths differ.
    """
    descriptors = np.ascontiguousarray(descriptors, np.uint8)
    angle, size = np.asarray(angles, np.float64), np.asarray(sizes, np.float64)
    n = len(descriptors)
    if descriptors.ndim != 2 or angle.shape != (n,) or size.shape != (n,):
        raise ValueError(
            f"descriptors {descriptors.shape}, angles {angle.shape} and sizes {size.shape} do not "
            "fit together: give (n, bytes), (n,) and (n,)"
        )
    bits = np.zeros((n, _ANGLES + _SIZES), np.uint8)
    bits[:, _ANGLES:] = size_bits(size)
    rows = np.flatnonzero(np.isfinite(angle) & (angle >= 0))
    own = (angle[rows] * (_ANGLES / 360)).astype(np.int64)
    for step in range(-_REACH, _REACH + 1):
        bits[rows, (own + step) % _ANGLES] = 1
    return np.hstack([descriptors, np.packbits(bits, axis=1, bitorder="little")])


def upright_tracks(tracks: Tracks) -> Tracks:
    """The tracks with such descriptors, named `<descriptor>-upright`.

    Raises:
        ValueError: no keypoint has an angle.
    """
    if not (tracks.angles >= 0).any():
        raise ValueError(
            f"no keypoint of these {tracks.descriptor} tracks has an angle; the upright encoders "
            "need them"
        )
    return replace(
        tracks,
        descriptor=tracks.descriptor + SUFFIX,
        descriptors=upright_descriptors(tracks.descriptors, tracks.angles, tracks.sizes),
    )
