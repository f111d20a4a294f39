"""Real landmarks, synthetic landmarks in any number, and queries.

A synthetic landmark has two parents: a random real landmark, and one of its nearest. Each byte of
its descriptors comes from one of the parents, the same one in all its observations. An observation
takes the bytes of a random observation of each parent, so that bytes have the values of real bytes,
and a landmark's observations differ as real ones do. One observation of each parent is held out and
makes the landmark's query: a further observation, which the map does not contain.

As parents are near each other, synthetic landmarks have the distribution of real ones, but are
denser. Each run verifies that FAISS finds as many neighbours among synthetic as among real
landmarks (`sections.measure_resemblance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.tracks.file import Tracks, sequence_name

OBSERVATIONS = 6  # per synthetic landmark
_CHUNK = 1 << 15  # landmarks that are generated at a time


@dataclass(frozen=True)
class RealLandmarks:
    """Observations of real landmarks, grouped by landmark, one sequence after the other.

    Attributes:
        descriptor: name of the descriptor.
        sequences: names of the sequences.
        descriptors: (n, bits / 8) uint8.
        starts: (l + 1,) int64; rows starts[i]:starts[i + 1], at least two, are of landmark i. The
            last of them is held out for queries.
    """

    descriptor: str
    sequences: tuple[str, ...]
    descriptors: NDArray[np.uint8]
    starts: NDArray[np.int64]

    @classmethod
    def load(cls, paths: Sequence[Path]) -> RealLandmarks:
        """Load tracks files of one descriptor; without any, the bundled sample.

        Raises:
            FileNotFoundError, ValueError: a file is missing, broken, or of another descriptor.
        """
        if not paths:
            from protomark import sample

            paths = [sample.path()]
        return cls.of([Tracks.load(path) for path in paths], [sequence_name(p) for p in paths])

    @classmethod
    def of(cls, tracks: Sequence[Tracks], names: Sequence[str]) -> RealLandmarks:
        """Take landmarks with at least two observations, shuffled reproducibly.

        Raises:
            ValueError: the tracks have different descriptors, or too few landmarks.
        """
        kinds = {(t.descriptor, t.bits) for t in tracks}
        if len(kinds) > 1:
            raise ValueError(
                "give tracks of one descriptor, not of "
                + ", ".join(sorted(f"{name} ({bits} bits)" for name, bits in kinds))
            )
        rng = np.random.default_rng(0)
        descriptors, counts = [], []
        for t in tracks:
            rows = rng.permutation(t.observations)
            landmark = np.searchsorted(t.landmark_ids, t.landmark_of_keypoint[rows])
            count = np.bincount(landmark, minlength=len(t.landmark_ids))
            used = count[landmark] >= 2
            order = np.argsort(landmark[used], kind="stable")
            descriptors.append(t.descriptors[rows[used][order]])
            counts.append(count[count >= 2])
        starts = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
        if len(starts) < 3:
            raise ValueError(
                "the tracks have fewer than two landmarks with two observations: give longer ones"
            )
        return cls(tracks[0].descriptor, tuple(names), np.concatenate(descriptors), starts)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> NDArray[np.int64]:
        """(l,) int64, observations of each landmark that are not held out."""
        return np.diff(self.starts) - 1

    @property
    def in_map(self) -> NDArray[np.bool_]:
        """(n,) bool, whether each row is not held out."""
        used = np.ones(len(self.descriptors), bool)
        used[self.starts[1:] - 1] = False
        return used

    def queries(self, landmarks: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The held-out observation (q, bits / 8) of each landmark (q,)."""
        return self.descriptors[self.starts[landmarks + 1] - 1]

    def prototypes(self, encoder: pm.Encoder, dim: int, threads: int = 1) -> NDArray[np.int8]:
        """Rounded mean codes (l, dim), without held-out observations."""
        codes = encoder.encode(self.descriptors, dim=dim, threads=threads).astype(np.int32)
        codes[~self.in_map] = 0
        return rounded_means(np.add.reduceat(codes, self.starts[:-1]), self.counts[:, None])


@dataclass(frozen=True)
class _Parents:
    """Both parents of each landmark in a chunk, and whether each byte is the second one's."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    from_second: NDArray[np.bool_]


class SyntheticLandmarks:
    """Landmarks 0, 1, 2, ... without end; the first n do not depend on n.

    Args:
        real: their parents.
        encoder: encodes descriptors.
        dim: code length.
        observations: number of observations per landmark.
        neighbours: number of landmarks, nearest to the first parent, to draw the second from.
        seed: seed of the landmarks.
        threads: threads to encode on.
    """

    def __init__(
        self,
        real: RealLandmarks,
        encoder: pm.Encoder,
        dim: int,
        *,
        observations: int = OBSERVATIONS,
        neighbours: int = 128,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        self.real = real
        self.encoder = encoder
        self.dim = dim
        self.observations = observations
        self._seed = seed
        self._threads = threads
        self._nearest = _nearest(real.prototypes(encoder, dim), encoder, neighbours, threads)

    def descriptors(self, n: int) -> NDArray[np.uint8]:
        """Descriptors (n * observations, bits / 8) of the first n landmarks, by landmark."""
        result = np.empty((n * self.observations, self.encoder.bits // 8), np.uint8)
        for begin in range(0, n, _CHUNK):
            rows = self._chunk(begin // _CHUNK)[: (n - begin) * self.observations]
            start = begin * self.observations
            result[start : start + len(rows)] = rows
        return result

    def prototypes(self, n: int, first: int = 0) -> NDArray[np.int8]:
        """Rounded mean codes (n, dim) of n landmarks from `first` on."""
        result = np.empty((n, self.dim), np.int8)
        at = 0
        while at < n:
            chunk, skip = divmod(first + at, _CHUNK)
            take = min(_CHUNK - skip, n - at)
            rows = self._chunk(chunk)[skip * self.observations :][: take * self.observations]
            codes = self.encoder.encode(rows, dim=self.dim, threads=self._threads)
            sums = codes.reshape(-1, self.observations, self.dim).sum(axis=1, dtype=np.int32)
            result[at : at + take] = rounded_means(sums, self.observations)
            at += take
        return result

    def queries(self, landmarks: NDArray[np.int64]) -> NDArray[np.uint8]:
        """A further observation (q, bits / 8) of each landmark."""
        result = np.empty((len(landmarks), self.encoder.bits // 8), np.uint8)
        chunks = landmarks // _CHUNK
        for chunk in np.unique(chunks):
            asked = np.flatnonzero(chunks == chunk)
            parents, _ = self._parents(int(chunk))
            at = landmarks[asked] % _CHUNK
            result[asked] = np.where(
                parents.from_second[at],
                self.real.queries(parents.second[at]),
                self.real.queries(parents.first[at]),
            )
        return result

    def _parents(self, chunk: int) -> tuple[_Parents, np.random.Generator]:
        rng = np.random.default_rng([self._seed, chunk])
        first = rng.integers(0, len(self.real), _CHUNK)
        second = self._nearest[first, rng.integers(0, self._nearest.shape[1], _CHUNK)]
        from_second = rng.integers(0, 2, (_CHUNK, self.encoder.bits // 8), np.uint8).astype(bool)
        return _Parents(first, second, from_second), rng

    def _chunk(self, chunk: int) -> NDArray[np.uint8]:
        parents, rng = self._parents(chunk)
        from_second = np.repeat(parents.from_second, self.observations, axis=0)
        second, first = self._draw(parents.second, rng), self._draw(parents.first, rng)
        return np.where(from_second, second, first)

    def _draw(self, parents: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Draw random observations of each parent, without held-out ones."""
        share = rng.random((len(parents), self.observations), np.float32)
        counts = self.real.counts[parents][:, None]
        number = np.minimum((share * counts).astype(np.int64), counts - 1)
        return self.real.descriptors[(self.real.starts[parents][:, None] + number).ravel()]


class Workload:
    """The landmarks, maps and queries that all sections share.

    Attributes:
        real: real landmarks.
        encoder: the encoder that ships for their descriptor.
        dim: code length.
        build_threads: threads to generate data on.
    """

    def __init__(
        self, real: RealLandmarks, encoder: pm.Encoder, dim: int = 32, build_threads: int = 1
    ) -> None:
        self.real = real
        self.encoder = encoder
        self.dim = dim
        self.build_threads = build_threads
        self._prototypes = np.empty((0, dim), np.int8)
        self._map: tuple[int, pm.PrototypeMap] | None = None

    @cached_property
    def synthetic(self) -> SyntheticLandmarks:
        """Synthetic landmarks with the default number of observations."""
        return SyntheticLandmarks(self.real, self.encoder, self.dim, threads=self.build_threads)

    def prototypes(self, n: int) -> NDArray[np.int8]:
        """Prototypes (n, dim) of the first n synthetic landmarks; the largest set is cached."""
        if len(self._prototypes) < n:
            self._prototypes = self.synthetic.prototypes(n)
        return self._prototypes[:n]

    def map(self, n: int) -> pm.PrototypeMap:
        """A learning map of these prototypes, which is cached and must not be changed."""
        if self._map is None or self._map[0] != n:
            self._map = None
            self._map = (n, map_of(self.encoder, self.prototypes(n)))
        return self._map[1]

    def forget(self) -> None:
        """Clear the caches."""
        self._prototypes = self._prototypes[:0].copy()
        self._map = None

    def queries(self, n: int, count: int) -> NDArray[np.uint8]:
        """Further observations (count, bits / 8) of random ones of the first n landmarks."""
        landmarks = np.random.default_rng([7, n]).integers(0, n, count)
        return self.synthetic.queries(landmarks)

    def codes(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int8]:
        """Codes (n, dim) of descriptors."""
        return self.encoder.encode(descriptors, dim=self.dim)


def rounded_means(sums: NDArray[np.int32], counts: int | NDArray[np.int64]) -> NDArray[np.int8]:
    """Sums over counts, rounded to integers, halves away from zero."""
    means = (2 * np.abs(sums) + counts) // (2 * np.asarray(counts))
    return (np.sign(sums) * means).astype(np.int8)


def map_of(encoder: pm.Encoder, prototypes: NDArray[np.int8]) -> pm.PrototypeMap:
    """A learning map whose landmark i has one observation, prototype i of (n, dim)."""
    result = pm.PrototypeMap(encoder, dim=prototypes.shape[1])
    for begin in range(0, len(prototypes), 1 << 20):
        part = prototypes[begin : begin + (1 << 20)]
        result.add_codes(np.arange(begin, begin + len(part)), part)
    return result


def _nearest(
    prototypes: NDArray[np.int8], encoder: pm.Encoder, neighbours: int, threads: int
) -> NDArray[np.int64]:
    """The nearest landmarks (l, neighbours) of each one, without itself."""
    count = min(neighbours, len(prototypes) - 1)
    found, _ = map_of(encoder, prototypes).search_codes(prototypes, k=count + 1, threads=threads)
    others = found != np.arange(len(prototypes))[:, None]
    # Equal landmarks with smaller ids may have displaced the landmark itself.
    others[others.all(axis=1), -1] = False
    return found[others].reshape(-1, count)
