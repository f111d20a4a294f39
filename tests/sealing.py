"""Helpers for sealed maps whose prototypes are words, written from docs/format.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import protomark as pm


def in_words(scene: pm.PrototypeMap, prototypes: float | None = None) -> float:
    """`bytes_per_landmark` for words of all numbers, and prototypes per landmark (None: all).

    Of several codebooks, it is for the one with the shortest words.
    """
    existing = scene.prototype_count / max(len(scene), 1) if len(scene) else 1.0
    wanted = existing if prototypes is None else prototypes
    several = wanted > 1 and existing > 1
    widths = [
        width
        for subspaces, _, width in (codebook.shape for codebook in scene.encoder.codebooks)
        if scene.dim % width == 0 and subspaces * width >= scene.dim
    ]
    return wanted * (scene.dim // min(widths)) + (1 if several else 0)


def decoded(words: NDArray[np.integer], codebook: NDArray[np.int8]) -> NDArray[np.int64]:
    """The numbers (n, dim) of words (n, dim / width)."""
    subspaces = np.arange(words.shape[1])
    return codebook[subspaces, words].reshape(len(words), -1).astype(np.int64)


def quantized(prototypes: NDArray[np.int64], codebook: NDArray[np.int8]) -> NDArray[np.int64]:
    """The nearest words of rounded prototypes (n, dim), ties to the first, as numbers."""
    width = codebook.shape[2]
    parts = prototypes.reshape(len(prototypes), -1, 1, width)
    squared = ((parts - codebook[: parts.shape[1]].astype(np.int64)) ** 2).sum(-1)
    return decoded(squared.argmin(-1), codebook)
