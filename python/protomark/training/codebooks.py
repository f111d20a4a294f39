"""Learns the codebooks that sealed maps store prototypes by (Jegou et al., PAMI 2011)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.baselines.quantization import WORDS, k_means
from protomark.progress import Progress, silent, tracked
from protomark.training.sampling import Views

# Numbers per word: 2 for the best prototypes, 3 for the smallest.
WIDTHS = (2, 3)
# Landmarks of each sequence.
MAX_LANDMARKS = 10_000


def with_codebooks(
    encoder: pm.Encoder, sequences: Sequence[Views], progress: Progress = silent
) -> pm.Encoder:
    """The encoder with codebooks that fit prototypes of these sequences, tuned as maps have them.

    A codebook covers as many numbers of a code as are whole words.
    """
    prototypes = np.concatenate([tuned_prototypes(encoder, views) for views in sequences])
    covered = {w: encoder.dim // w * w for w in WIDTHS}
    parts = [(w, at) for w in WIDTHS for at in range(0, covered[w], w)]
    words = {
        (w, at): words_of(prototypes[:, at : at + w])
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


def words_of(points: NDArray[np.int8]) -> NDArray[np.int8]:
    """256 words (256, width) near to points (n, width)."""
    words = np.rint(k_means(points, WORDS, np.random.default_rng(0)))
    return np.clip(words, -127, 127).astype(np.int8)
