"""Draws batches of landmarks for training from tracks.

A batch holds landmarks of one sequence, as a map confuses landmarks of one scene. Sequences are
drawn with a probability that is a power of their size, so that a long one does not dominate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.descriptors import InputKind
from protomark.tracks.file import Tracks


@dataclass(frozen=True)
class Views:
    """All views of one sequence's landmarks, grouped by landmark."""

    name: str
    descriptors: NDArray[Any]  # (n, b), sorted by landmark
    # (l + 1,) int64; the views of landmark i are rows starts[i]:starts[i + 1].
    starts: NDArray[np.int64]
    kind: InputKind = "bits"  # what the descriptors are

    @classmethod
    def from_tracks(cls, tracks: Tracks, name: str) -> Views:
        """The observations of `tracks`, without landmarks that have none."""
        rows = tracks.observations
        landmarks = tracks.landmark_of_keypoint[rows]
        order = np.argsort(landmarks, kind="stable")
        _, counts = np.unique(landmarks, return_counts=True)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        descriptors = np.ascontiguousarray(tracks.descriptors[rows[order]])
        return cls(name, descriptors, starts, tracks.input)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> NDArray[np.int64]:
        """(l,) int64, number of views of each landmark."""
        return np.diff(self.starts)


@dataclass(frozen=True)
class Batch:
    """The views of a batch's landmarks."""

    descriptors: NDArray[Any]  # (n, b), grouped by landmark
    landmarks: NDArray[np.int64]  # (n,) int64, 0..m-1, ascending
    # (q,) int64, rows whose landmark has at least two other views in the batch.
    queries: NDArray[np.int64]


def random_views(
    views: Views,
    landmarks: NDArray[np.int64],
    limit: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Up to `limit` random views of each landmark.

    Returns:
        Rows (n,) int64 of `views.descriptors`; their groups (n,) int64, ascending indices into
        `landmarks`; the random rank (n,) int64 of each row in its group.
    """
    counts = views.counts[landmarks]
    group = np.repeat(np.arange(len(landmarks)), counts)
    first = np.cumsum(counts) - counts
    rows = np.arange(len(group)) - np.repeat(first, counts) + views.starts[landmarks][group]
    order = np.lexsort((rng.random(len(rows)), group))
    rank = np.arange(len(rows)) - first[group]
    keep = rank < limit
    return rows[order][keep], group[keep], rank[keep]


def with_noise(
    descriptors: NDArray[Any], kind: InputKind, noise: float, rng: np.random.Generator
) -> NDArray[Any]:
    """Descriptors (n, b) with a share `noise` of the bits flipped.

    Vectors have Gaussian noise added, whose mean square is this share of their own.
    """
    if kind == "bits":
        flips = rng.random((len(descriptors), 8 * descriptors.shape[1]), np.float32) < noise
        return descriptors ^ np.packbits(flips, axis=1, bitorder="little")
    x = descriptors.astype(np.float32)
    size = np.sqrt(noise * np.square(x).mean(1, keepdims=True))
    x += size * rng.standard_normal(x.shape, np.float32)
    return x if kind == "float32" else np.rint(x).clip(0, 255).astype(np.uint8)


@dataclass
class BatchSampler:
    """Draws batches from several sequences."""

    sequences: Sequence[Views]  # one or more sequences, each with landmarks of 3 or more views
    landmarks: int = 1000  # landmarks per batch
    views: int = 9  # limit on views per landmark
    queries: int = 3  # limit on queries per landmark
    # The probability of a sequence is proportional to (number of landmarks with 3 or more views)
    # ** balance: 0 favours no sequence, 1 favours no landmark.
    balance: float = 0.5
    noise: float = 0.0  # see `with_noise`

    def __post_init__(self) -> None:
        sizes = np.array([(s.counts >= 3).sum() for s in self.sequences], float)
        self.probability = sizes**self.balance / (sizes**self.balance).sum()

    def choose(self, sequence: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Distinct random landmarks (m,) int64 for a batch."""
        views = self.sequences[sequence]
        size = min(self.landmarks, len(views))
        return rng.choice(len(views), size, replace=False, shuffle=False)

    def sample(self, rng: np.random.Generator) -> Batch:
        """Draw a batch; the same state of `rng` yields the same batch."""
        sequence = int(rng.choice(len(self.sequences), p=self.probability))
        views = self.sequences[sequence]
        chosen = self.choose(sequence, rng)
        rows, group, rank = random_views(views, chosen, self.views, rng)
        descriptors = views.descriptors[rows]
        if self.noise:
            descriptors = with_noise(descriptors, views.kind, self.noise, rng)
        enough = np.bincount(group)[group] >= 3
        return Batch(descriptors, group, np.flatnonzero(enough & (rank < self.queries)))
