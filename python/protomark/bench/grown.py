"""More landmarks than there are, of the same kind: crossed from pairs of real ones.

A grown landmark has two parents. The first is any real landmark, the second one of those nearest to
it. Each byte of its descriptors comes from one or the other parent, the same one in all its
observations. An observation takes the bytes of one observation of each parent, drawn at random,
so a byte has the values that real bytes have, and looks of a landmark differ as real looks do. One
observation of each parent is kept out and makes the landmark's query: a query is a further
observation, of which the map holds no part.

Parents near each other keep grown landmarks where real ones lie, and each as far from its
neighbours as crowding makes it. That FAISS finds as many neighbours in grown as in real data of the
same size is measured in each run (`resemblance`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.bench.real import Observations

OBSERVATIONS = 6  # of a grown landmark
_CHUNK = 1 << 15  # landmarks made at a time


@dataclass(frozen=True)
class _Recipe:
    """Of the landmarks of one chunk: their parents, and which bytes are the second parent's."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    crossed: NDArray[np.bool_]


class Grown:
    """Landmarks 0, 1, 2, ... without end; the first n are the same whatever n is.

    Args:
        real: what they are made of.
        encoder: makes codes of descriptors.
        dim: length of a code.
        observations: of each landmark.
        neighbours: the second parent is one of so many nearest to the first.
        seed: another one gives other landmarks.
        threads: threads to encode on.
    """

    def __init__(
        self,
        real: Observations,
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
        self._near = _nearest(prototypes_of(real, encoder, dim), encoder, neighbours, threads)

    def descriptors(self, n: int) -> NDArray[np.uint8]:
        """Descriptors of the first n landmarks, (n * observations, bits / 8), by landmark."""
        result = np.empty(
            (n * self.observations, self.encoder.bits // 8),
            np.uint8,
        )
        for begin in range(0, n, _CHUNK):
            rows = self._chunk(begin // _CHUNK)[: (n - begin) * self.observations]
            at = begin * self.observations
            result[at : at + len(rows)] = rows
        return result

    def prototypes(self, n: int, first: int = 0) -> NDArray[np.int8]:
        """Rounded mean codes of n landmarks from `first` on, (n, dim)."""
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
        """One further observation of each of these landmarks, (q, bits / 8)."""
        result = np.empty((len(landmarks), self.encoder.bits // 8), np.uint8)
        chunks = landmarks // _CHUNK
        for chunk in np.unique(chunks):
            asked = np.flatnonzero(chunks == chunk)
            recipe, _ = self._recipe(int(chunk))
            at = landmarks[asked] % _CHUNK
            result[asked] = np.where(
                recipe.crossed[at],
                self.real.queries(recipe.second[at]),
                self.real.queries(recipe.first[at]),
            )
        return result

    def _recipe(self, chunk: int) -> tuple[_Recipe, np.random.Generator]:
        rng = np.random.default_rng([self._seed, chunk])
        first = rng.integers(0, len(self.real), _CHUNK)
        second = self._near[first, rng.integers(0, self._near.shape[1], _CHUNK)]
        crossed = rng.integers(0, 2, (_CHUNK, self.encoder.bits // 8), np.uint8).astype(bool)
        return _Recipe(first, second, crossed), rng

    def _chunk(self, chunk: int) -> NDArray[np.uint8]:
        recipe, rng = self._recipe(chunk)
        crossed = np.repeat(recipe.crossed, self.observations, axis=0)
        return np.where(crossed, self._drawn(recipe.second, rng), self._drawn(recipe.first, rng))

    def _drawn(self, parents: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Observations of each parent, drawn at random from those that are not kept out."""
        share = rng.random((len(parents), self.observations), np.float32)
        counts = self.real.counts[parents][:, None]
        number = np.minimum((share * counts).astype(np.int64), counts - 1)
        return self.real.descriptors[(self.real.starts[parents][:, None] + number).ravel()]


def prototypes_of(
    real: Observations, encoder: pm.Encoder, dim: int, threads: int = 1
) -> NDArray[np.int8]:
    """Rounded mean codes of the real landmarks, (l, dim); queries' observations are left out."""
    codes = encoder.encode(real.descriptors, dim=dim, threads=threads).astype(np.int32)
    codes[~real.map_rows] = 0
    return rounded_means(np.add.reduceat(codes, real.starts[:-1]), real.counts[:, None])


def rounded_means(sums: NDArray[np.int32], counts: int | NDArray[np.int64]) -> NDArray[np.int8]:
    """Sums over counts, to the nearest integer, halves away from zero."""
    return (np.sign(sums) * ((2 * np.abs(sums) + counts) // (2 * np.asarray(counts)))).astype(
        np.int8
    )


def map_of(encoder: pm.Encoder, prototypes: NDArray[np.int8]) -> pm.PrototypeMap:
    """An open map whose landmark i has prototype i, (n, dim) int8, seen once."""
    result = pm.PrototypeMap(encoder, dim=prototypes.shape[1])
    for begin in range(0, len(prototypes), 1 << 20):
        part = prototypes[begin : begin + (1 << 20)]
        result.add_codes(np.arange(begin, begin + len(part)), part)
    return result


def _nearest(
    prototypes: NDArray[np.int8], encoder: pm.Encoder, neighbours: int, threads: int
) -> NDArray[np.int64]:
    """(l, neighbours) numbers of the landmarks nearest to each, itself left out."""
    wanted = min(neighbours, len(prototypes) - 1)
    found, _ = map_of(encoder, prototypes).search_codes(prototypes, k=wanted + 1, threads=threads)
    others = found != np.arange(len(prototypes))[:, None]
    # A twin with a smaller id may have pushed the landmark itself out.
    others[others.all(axis=1), -1] = False
    return found[others].reshape(-1, wanted)
