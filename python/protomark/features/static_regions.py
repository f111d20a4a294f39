"""Finds regions of the image that never move while the rest does: overlays, logos, a bonnet."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.images import read_gray

Mask = NDArray[np.bool_]

# Cells of this share of the image's longer side are judged as a whole.
_CELL = 1 / 40
# A keypoint is stationary if its match lies within so many pixels. A cell is static if this share
# of its matches is stationary, in this many pairs of frames at least.
_MAX_MOTION = 1.5
_MIN_STATIONARY = 0.6
_MIN_PAIRS = 6
_MIN_MATCHES = 8
# In pairs of frames of which less has moved, the camera may have stood still.
_MIN_MOVED = 0.15
# What a camera circles around never moves either, but fills fewer cells.
_MIN_CELLS = 4
_MAX_NAMED = 3


def static_regions(
    pairs: Iterable[tuple[NDArray[Any], NDArray[Any]]],
    size: tuple[int, int],
    pixel: float = 1.0,
) -> Mask:
    """A mask (height, width) that is true where the image does not move with the scene.

    Args:
        pairs: pixels (n, 2) of the matches of two frames, in each of them.
        size: width and height of the images.
        pixel: see `pixel_size`.
    """
    width, height = size
    cell = max(8, round(_CELL * max(size)))
    shape = -(-height // cell), -(-width // cell)
    stationary, moving, frequency = (np.zeros(shape, np.int64) for _ in range(3))
    for first, second in pairs:
        if not len(first):
            continue
        still = np.linalg.norm(second - first, axis=1) <= _MAX_MOTION * pixel
        if (~still).mean() < _MIN_MOVED:
            continue
        column, row = np.minimum(first // cell, [shape[1] - 1, shape[0] - 1]).astype(int).T
        here = np.zeros(shape, np.int64)
        np.add.at(here, (row[still], column[still]), 1)
        stationary += here
        frequency += here > 0
        np.add.at(moving, (row[~still], column[~still]), 1)
    static = (frequency >= _MIN_PAIRS) & (stationary >= _MIN_MATCHES)
    static &= stationary >= _MIN_STATIONARY * (stationary + moving)
    # Beside a static cell, one without evidence of motion belongs to the same region.
    cv2 = optional("cv2")
    count, part = cv2.connectedComponents(cv2.dilate(static.astype(np.uint8), np.ones((3, 3))))
    large = np.bincount(part[static], minlength=count) >= _MIN_CELLS
    static = large[part] & (moving <= stationary)
    return np.kron(static, np.ones((cell, cell), bool))[:height, :width]


def describe(static: Mask) -> str:
    """The static regions as a share of the image and their outlines, the largest first.

    Returns "" without any.
    """
    if not static.any():
        return ""
    cv2 = optional("cv2")
    _, _, boxes, _ = cv2.connectedComponentsWithStats(static.astype(np.uint8), connectivity=8)
    boxes = sorted(boxes[1:].tolist(), key=lambda box: -box[4])
    outlines = [f"x {x}-{x + w}, y {y}-{y + h}" for x, y, w, h, _ in boxes[:_MAX_NAMED]]
    more = f" and {len(boxes) - _MAX_NAMED} more" if len(boxes) > _MAX_NAMED else ""
    return f"{100 * static.mean():.0f} % of the image ({'; '.join(outlines)}{more})"


def read_mask(path: Path, size: tuple[int, int]) -> Mask:
    """The part of the image that a mask leaves out: its black pixels, as in COLMAP.

    Raises:
        FileNotFoundError, ValueError: it cannot be read, is all black, or has another size.
    """
    image = read_gray(path)
    if image.shape[::-1] != size:
        raise ValueError(
            f"{path}: the mask has {image.shape[1]}x{image.shape[0]} pixels, the images have "
            f"{size[0]}x{size[1]}: scale the mask"
        )
    if not image.any():
        raise ValueError(
            f"{path}: the mask is black, so no pixel would be used: paint white what is"
        )
    return image == 0


def outside(static: Mask, keypoints: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which keypoints (n, 2) lie outside of the masked regions."""
    column, row = keypoints.astype(np.int64).T
    height, width = static.shape
    return ~static[row.clip(0, height - 1), column.clip(0, width - 1)]
