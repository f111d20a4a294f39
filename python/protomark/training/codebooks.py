"""Learns the codebooks that sealed maps store prototypes by (Jegou et al., PAMI 2011)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.progress import Progress, silent, tracked
from protomark.training.sampling import Views

# Numbers per word: 2 for the best prototypes, 3 for the smallest.
WIDTHS = (2, 3)
WORDS = 256
# Landmarks of each sequence.
MAX_LANDMARKS = 10_000
ITERATIONS = 25


def with_codebooks(
    encoder: pm.Encoder, sequences: Sequence[Views], progress: Progress = silent
) -> pm.Encoder:
    """The encoder with codebooks that fit prototypes of these sequences, tuned as maps have them.

    A codebook covers the longest codes whose length is a multiple of its width.
    """
    prototypes = np.concatenate([tuned_prototypes(encoder, views) for views in sequences])
    covered = {w: max((d for d in encoder.dims if d % w == 0), default=0) for w in WIDTHS}
    parts = [(w, at) for w in WIDTHS for at in range(0, covered[w], w)]
    words = {
        (w, at): k_means(prototypes[:, at : at + w], WORDS)
        for w, at in tracked(parts, progress, "learn codebooks")
    }
    books = [
        np.stack([words[w, at] for at in range(0, covered[w], w)]) for w in WIDTHS if covered[w]
    ]
    return encoder.with_codebooks(books)


def tuned_prototypes(encoder: pm.Encoder, views: Views, seed: int = 0) -> NDArray[np.int8]:
    """Prototypes (l, dim) int8 of landmarks of a sequence, tuned by their observations."""
    ids = np.repeat(np.arange(len(views)), views.counts)
    rng = np.random.default_rng(seed)
    chosen = np.isin(ids, rng.permutation(len(views))[:MAX_LANDMARKS])
    ids, descriptors = ids[chosen], views.descriptors[chosen]
    scene = pm.PrototypeMap(encoder)
    scene.add(ids, descriptors)
    with tempfile.TemporaryDirectory(prefix="protomark-") as folder:
        sealed = scene.seal(
            Path(folder) / "s.pmk", ids, descriptors, bytes_per_landmark=encoder.dim + 1
        )
        return sealed.prototypes(scene.ids).astype(np.int8)


def k_means(points: NDArray[np.int8], k: int, seed: int = 0) -> NDArray[np.int8]:
    """Words (k, width) int8 near to points (n, width), by Lloyd's algorithm.

    Fewer than k distinct points are words themselves, some of them several times.
    """
    rng = np.random.default_rng(seed)
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    x = distinct.astype(np.float32)
    words = x[rng.permutation(max(len(x), k))[:k] % len(x)]
    for _ in range(ITERATIONS if len(x) > k else 0):
        distances = (words**2).sum(1) - 2 * x @ words.T
        nearest = distances.argmin(1)
        mass = np.bincount(nearest, counts, minlength=k)
        sums = np.stack(
            [np.bincount(nearest, counts * column, minlength=k) for column in x.T], axis=1
        )
        words[mass > 0] = (sums[mass > 0] / mass[mass > 0, None]).astype(np.float32)
        # A word without points moves to the point that is worst served.
        worst = np.argsort(-counts * (distances.min(1) + (x**2).sum(1)))
        words[mass == 0] = x[worst[: int((mass == 0).sum())]]
    return np.clip(np.rint(words), -127, 127).astype(np.int8)
