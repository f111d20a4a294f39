"""Product quantisation of the landmark's mean of bits."""

from __future__ import annotations

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
    """The mean of all bits as `size` words of a byte each, and one byte for the count.

    Jégou et al., "Product quantization for nearest neighbor search", TPAMI 2011. Each of `size`
    parts of the mean has a codebook of `WORDS` words, learned from the map's own means. Distances
    are asymmetric: between the query's bits and the words.
    """
    rng = np.random.default_rng(support.seed)
    means = support.means
    drawn = np.arange(len(means))
    if len(means) > MAX_MEANS:
        drawn = np.sort(rng.choice(len(means), MAX_MEANS, replace=False))
    decoded = np.empty_like(means)
    for part in np.array_split(np.arange(support.bits), size):
        values = means[:, part]
        words = k_means(values[drawn], WORDS, rng)
        decoded[:, part] = words[nearest_words(values, words)]
    return EuclideanMap(decoded, support.ids, size + 1)


def k_means(
    values: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Words (k, d) of values (n, d) by Lloyd's iterations; k is `count`, or n if that is less."""
    words = values[rng.choice(len(values), min(count, len(values)), replace=False)]
    for _ in range(PASSES):
        nearest = nearest_words(values, words)
        sizes = np.bincount(nearest, minlength=len(words))
        order = np.argsort(nearest, kind="stable")
        used = np.flatnonzero(sizes)
        starts = np.cumsum(sizes)[used] - sizes[used]
        words = words.copy()
        words[used] = np.add.reduceat(values[order], starts, axis=0) / sizes[used, None]
        # A word that no value is nearest to is drawn anew.
        unused = np.flatnonzero(sizes == 0)
        words[unused] = values[rng.choice(len(values), len(unused))]
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
