"""The real observations that a bench starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.tracks.file import Tracks, sequence_name


@dataclass(frozen=True)
class Observations:
    """Observations of real landmarks, grouped by landmark, sequences one after the other.

    Attributes:
        descriptor: name of the descriptor.
        sequences: names of the sequences.
        descriptors: (n, bits / 8) uint8.
        starts: (l + 1,) int64; those of landmark i are rows starts[i]:starts[i + 1], at least 2.
            The last one is left out of maps: it is what queries are made of.
    """

    descriptor: str
    sequences: tuple[str, ...]
    descriptors: NDArray[np.uint8]
    starts: NDArray[np.int64]

    @classmethod
    def load(cls, paths: Sequence[Path]) -> Observations:
        """Those of tracks files, of one descriptor; of the sample that ships if there are none.

        Raises:
            FileNotFoundError, ValueError: a file is missing, broken, or of another descriptor.
        """
        if not paths:
            from protomark import sample

            paths = [sample.path()]
        return cls.of([Tracks.load(path) for path in paths], [sequence_name(p) for p in paths])

    @classmethod
    def of(cls, tracks: Sequence[Tracks], names: Sequence[str]) -> Observations:
        """Those of landmarks with at least two; in an order drawn at random, but always the same.

        Raises:
            ValueError: the tracks have different descriptors.
        """
        kinds = {(t.descriptor, t.bits) for t in tracks}
        if len(kinds) > 1:
            raise ValueError(
                "tracks of one descriptor are needed, not of "
                + ", ".join(sorted(f"{name} ({bits} bits)" for name, bits in kinds))
            )
        rng = np.random.default_rng(0)
        descriptors, counts = [], []
        for t in tracks:
            rows = rng.permutation(t.observations)
            landmark = np.searchsorted(t.landmark_ids, t.landmark_of_keypoint[rows])
            often = np.bincount(landmark, minlength=len(t.landmark_ids))
            kept = often[landmark] >= 2
            order = np.argsort(landmark[kept], kind="stable")
            descriptors.append(t.descriptors[rows[kept][order]])
            counts.append(often[often >= 2])
        starts = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
        if len(starts) < 3:
            raise ValueError("the tracks have fewer than two landmarks with two observations")
        return cls(tracks[0].descriptor, tuple(names), np.concatenate(descriptors), starts)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> NDArray[np.int64]:
        """(l,) int64, observations of each landmark that maps hold."""
        return np.diff(self.starts) - 1

    @property
    def map_rows(self) -> NDArray[np.bool_]:
        """(n,) bool, which rows maps hold."""
        kept = np.ones(len(self.descriptors), bool)
        kept[self.starts[1:] - 1] = False
        return kept

    def queries(self, landmarks: NDArray[np.int64]) -> NDArray[np.uint8]:
        """(q,) numbers of landmarks -> (q, bits / 8), the observation of each that maps lack."""
        return self.descriptors[self.starts[landmarks + 1] - 1]
