"""Helpers for sealed maps of 4 bits per number, written from docs/format.md."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

import protomark as pm


def four_bits(scene: pm.PrototypeMap, prototypes: float | None = None) -> float:
    """`bytes_per_landmark` for this number of prototypes per landmark; None: all."""
    existing = scene.prototype_count / max(len(scene), 1) if len(scene) else 1.0
    wanted = existing if prototypes is None else prototypes
    several = wanted > 1 and existing > 1
    return wanted * (4 * -(-scene.dim // 8)) + (2 if several else 1)


def levels(scale: int) -> NDArray[np.int64]:
    return scale * (2 * np.arange(16) - 15)


@cache
def nearest_levels(scale: int) -> NDArray[np.int64]:
    """The 4-bit level of each value from -128; ties go away from zero, zero goes up."""
    return np.array(
        [
            min(levels(scale).tolist(), key=lambda level: (abs(level - v), -abs(level), -level))
            for v in range(-128, 128)
        ]
    )


def quantized(prototypes: NDArray[np.int64], scale: int) -> NDArray[np.int64]:
    return nearest_levels(scale)[prototypes + 128]


def best_scale(prototypes: NDArray[np.int64]) -> int:
    errors = [((prototypes - quantized(prototypes, a)) ** 2).sum() for a in range(1, 9)]
    return 1 + int(np.argmin(errors))
