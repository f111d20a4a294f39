"""Landmarks and queries of any number, made once."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.bench.grown import Grown, map_of
from protomark.bench.real import Observations
from protomark.bench.settings import Settings


class Workload:
    """What all sections measure on.

    Attributes:
        real: real observations.
        encoder: the one that ships for their descriptor.
        settings: of the bench.
    """

    def __init__(self, real: Observations, encoder: pm.Encoder, settings: Settings) -> None:
        self.real = real
        self.encoder = encoder
        self.settings = settings
        self._prototypes = np.empty((0, settings.dim), np.int8)
        self._map: tuple[int, pm.PrototypeMap] | None = None

    @cached_property
    def grown(self) -> Grown:
        """Landmarks without end."""
        return Grown(
            self.real, self.encoder, self.settings.dim, threads=self.settings.build_threads
        )

    def prototypes(self, n: int) -> NDArray[np.int8]:
        """Of the first n grown landmarks, (n, dim); the largest set asked for is kept."""
        if len(self._prototypes) < n:
            self._prototypes = self.grown.prototypes(n)
        return self._prototypes[:n]

    def map(self, n: int) -> pm.PrototypeMap:
        """An open map of them, not to be changed; the last one asked for is kept."""
        if self._map is None or self._map[0] != n:
            self._map = None
            self._map = (n, map_of(self.encoder, self.prototypes(n)))
        return self._map[1]

    def forget(self) -> None:
        """Give back the memory of what is kept."""
        self._prototypes = np.empty((0, self.settings.dim), np.int8)
        self._map = None

    def queries(self, n: int, count: int) -> NDArray[np.uint8]:
        """Further observations of some of the first n landmarks, (count, bits / 8)."""
        landmarks = np.random.default_rng([7, n]).integers(0, n, count)
        return self.grown.queries(landmarks)

    def codes(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int8]:
        """Encoded, (n, dim)."""
        return self.encoder.encode(descriptors, dim=self.settings.dim)
