"""Adds a keypoint's angle and size to its descriptor, for cameras that stay upright.

Binary descriptors are rotated by the keypoint's angle so that they do not change as the camera
rolls. A camera that does not roll (on a car, a robot, a headset, a phone held as usual) observes
about the same angle at a landmark each time, so the angle tells landmarks apart, and so does the
size of the keypoint. Komorowski and Trzcinski name this as future work. Encoders
`<descriptor>-upright` take such longer descriptors, which both the map and the queries must have.
If the camera rolls (a drone that returns the other way), the plain encoder is better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SUFFIX = "-upright"
BYTES = 8
_ANGLE_BINS = 32  # of the full turn
_SIZE_BINS = 32  # a quarter octave each
_MIN_SIZE = 6.0  # pixels, of the first bin
# Neighbouring bins on either side that are set, too, so that near values share bits.
_ANGLE_REACH, _SIZE_REACH = 3, 2


def upright_descriptors(
    descriptors: NDArray[np.uint8], angles: ArrayLike, sizes: ArrayLike
) -> NDArray[np.uint8]:
    """Append 64 bits that encode the keypoint's angle and size.

    Args:
        descriptors: (n, B) uint8.
        angles: (n,) degrees, OpenCV's KeyPoint.angle; negative or NaN if unknown: no bit is set.
        sizes: (n,) pixels, OpenCV's KeyPoint.size; not positive or NaN if unknown: likewise.

    Returns:
        (n, B + 8) uint8: the descriptor, 32 bits for the angle (bins of 11.25 degrees, of which
        the keypoint's and three on either side are set), and 32 bits for the size (bins of a
        quarter octave from 6 pixels on, of which the keypoint's and two on either side are set).

    Raises:
        ValueError: the lengths of the arrays differ.
    """
    descriptors = np.ascontiguousarray(descriptors, np.uint8)
    angle, size = np.asarray(angles, np.float64), np.asarray(sizes, np.float64)
    n = len(descriptors)
    if descriptors.ndim != 2 or angle.shape != (n,) or size.shape != (n,):
        raise ValueError(
            f"descriptors {descriptors.shape}, angles {angle.shape} and sizes {size.shape} do not "
            "fit together: give (n, bytes), (n,) and (n,)"
        )
    bits = np.zeros((n, _ANGLE_BINS + _SIZE_BINS), np.uint8)
    rows = np.flatnonzero(np.isfinite(angle) & (angle >= 0))
    angle_bin = (angle[rows] * (_ANGLE_BINS / 360)).astype(np.int64)
    for step in range(-_ANGLE_REACH, _ANGLE_REACH + 1):
        bits[rows, (angle_bin + step) % _ANGLE_BINS] = 1
    rows = np.flatnonzero(np.isfinite(size) & (size > 0))
    octaves = np.log2(np.maximum(size[rows], 1.0) / _MIN_SIZE)
    size_bin = np.clip(np.floor(4 * octaves), 0, _SIZE_BINS - 1).astype(np.int64)
    for step in range(-_SIZE_REACH, _SIZE_REACH + 1):
        inside = (size_bin + step >= 0) & (size_bin + step < _SIZE_BINS)
        bits[rows[inside], _ANGLE_BINS + size_bin[inside] + step] = 1
    return np.hstack([descriptors, np.packbits(bits, axis=1, bitorder="little")])
