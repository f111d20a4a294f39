"""Product quantisation of the mean of a landmark's descriptors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.baselines.linear import EuclideanMap
from protomark.baselines.support import Support

WORDS = 256
# Means that codebooks are learned from, and passes of k-means (as FAISS).
MAX_MEANS = 64 * WORDS
PASSES = 25
# Distances of this many values to all words stay in the cache.
_ROWS = 1024


def product_quantized_mean(support: Support, size: int) -> EuclideanMap:
    """The mean of all numbers as `size` words of a byte each, and one byte for the count.

    Jégou et al., "Product quantization for nearest neighbor search", TPAMI 2011. Each of `size`
    parts of the mean has a codebook of `WORDS` words, learned from the map's own means. Distances
    are asymmetric: between the query's numbers and the words.
    """
    rng = np.random.default_rng(support.seed)
    means = support.means
    drawn = np.arange(len(means))
    if len(means) > MAX_MEANS:
        drawn = np.sort(rng.choice(len(means), MAX_MEANS, replace=False))
    decoded = np.empty_like(means)
    for part in np.array_split(np.arange(support.width), size):
        values = means[:, part]
        words = k_means(values[drawn], WORDS, rng)
        decoded[:, part] = words[nearest_words(values, words)]
    return EuclideanMap(decoded, support.ids, size + 1, support.kind)


def k_means(points: NDArray[Any], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Words (count, d) of points (n, d) by Lloyd's algorithm.

    Up to `count` distinct points are words themselves, some of them several times.
    """
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    x = distinct.astype(np.float32)
    words = x[rng.permutation(max(len(x), count))[:count] % len(x)]
    for _ in range(PASSES if len(x) > count else 0):
        distances = (words**2).sum(1) - 2 * x @ words.T
        nearest = distances.argmin(1)
        mass = np.bincount(nearest, counts, minlength=count)
        sums = np.stack(
            [np.bincount(nearest, counts * column, minlength=count) for column in x.T], axis=1
        )
        words[mass > 0] = (sums[mass > 0] / mass[mass > 0, None]).astype(np.float32)
        # A word without points moves to the point that is worst served.
        worst = np.argsort(-counts * (distances.min(1) + (x**2).sum(1)))
        words[mass == 0] = x[worst[: int((mass == 0).sum())]]
    return words


def nearest_words(values: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """Index (n,) of the word nearest to each value, ties to the first."""
    norms = np.einsum("ij,ij->i", words, words) / 2
    extended = np.concatenate([-words, norms[:, None]], axis=1).T
    nearest = np.empty(len(values), dtype=np.int64)
    for at in range(0, len(values), _ROWS):
        piece = values[at : at + _ROWS]
        ones = np.ones_like(piece[:, :1])
        nearest[at : at + _ROWS] = np.argmin(np.concatenate([piece, ones], 1) @ extended, axis=1)
    return nearest
