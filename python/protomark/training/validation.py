"""Measures precision by the paper's protocol, with float or integer prototypes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.evaluation.protocol import split
from protomark.features.descriptors import InputKind
from protomark.tracks.file import Tracks

Embed = Callable[[NDArray[Any]], NDArray[np.floating] | NDArray[np.int8]]


@dataclass(frozen=True)
class Trial:
    """Support and queries of a sequence at a seed."""

    name: str
    support: NDArray[Any]  # (n, b), grouped by landmark
    starts: NDArray[np.int64]  # (l,) int64, first row of each landmark in `support`
    queries: NDArray[Any]  # (q, b)
    targets: NDArray[np.int64]  # (q,) int64, landmarks of the queries, 0..l-1
    kind: InputKind = "bits"  # what the descriptors are

    @property
    def landmarks(self) -> NDArray[np.int64]:
        """(n,) int64, landmark of each row of `support`."""
        counts = np.diff(np.append(self.starts, len(self.support)))
        return np.repeat(np.arange(len(self.starts)), counts)

    @classmethod
    def from_tracks(
        cls, tracks: Tracks, name: str, seed: int = 0, max_queries: int = 10_000
    ) -> Trial:
        """A random 90/10 split of the keyframes."""
        try:
            drawn = split(tracks, seed, max_queries=max_queries)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        landmark = tracks.landmark_of_keypoint
        rows = drawn.support_rows[np.argsort(landmark[drawn.support_rows], kind="stable")]
        ids, starts = np.unique(landmark[rows], return_index=True)
        return cls(
            name,
            tracks.descriptors[rows],
            starts,
            tracks.descriptors[drawn.query_rows],
            np.searchsorted(ids, landmark[drawn.query_rows]),
            tracks.input,
        )


def precision(trial: Trial, embed: Embed, dims: Sequence[int]) -> dict[int, float]:
    """Share of queries whose nearest prototype is their landmark's, for each prefix in `dims`.

    int8 codes are compared with means rounded to int8, as in a map; floats with exact means.
    """
    support, queries = embed(trial.support), embed(trial.queries)
    counts = np.diff(np.append(trial.starts, len(support)))
    sums = np.add.reduceat(support.astype(np.float64), trial.starts, axis=0)
    means = sums / counts[:, None]
    if support.dtype == np.int8:
        means = np.trunc(means + np.copysign(0.5, means))
    prototypes, queries = means.astype(np.float32), queries.astype(np.float32)
    return {d: _share_right(queries[:, :d], prototypes[:, :d], trial.targets) for d in dims}


def _share_right(
    queries: NDArray[np.float32], prototypes: NDArray[np.float32], targets: NDArray[np.int64]
) -> float:
    norms = (prototypes**2).sum(1)
    right = 0
    # Integer codes are compared exactly, as whole numbers up to 2^24 are exact in float32.
    for i in range(0, len(queries), 512):
        distances = norms - (2 * queries[i : i + 512]) @ prototypes.T
        right += int((distances.argmin(1) == targets[i : i + 512]).sum())
    return right / len(queries)


def mean_precision(trials: Sequence[Trial], embed: Embed, dims: Sequence[int]) -> dict[int, float]:
    """`precision` averaged over trials."""
    each = [precision(trial, embed, dims) for trial in trials]
    return {d: float(np.mean([p[d] for p in each])) for d in dims}
