"""Precision on the test sequences, of trained networks and of what they are compared with."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from protomark.evaluation.methods import MethodChoice, choices
from protomark.evaluation.run import Options, evaluate
from protomark.tracks.file import Tracks
from protomark.training.network import embed
from protomark.training.validation import Trial, precision
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.paper.scale import SEEDS, Training
from protomark_bench.paper.trainer import TrainingOutcome

if TYPE_CHECKING:
    import protomark as pm

BASELINES = ("unaggregated", "majority", "pca-16-float", "random")
SHIPPED_DIMS = (32, 16)


@dataclass(frozen=True)
class MethodFigures:
    """Figures of methods that need no training here.

    Attributes:
        precision: name -> one number a seed.
        bytes_per_landmark: name -> mean over seeds.
    """

    precision: dict[str, list[float]]
    bytes_per_landmark: dict[str, float]


class MeasuredSequence:
    """One test sequence, and what is measured on it, from the cache if it is there.

    Args:
        name: of the sequence.
        path: of its tracks file.
        cache: of figures.
    """

    def __init__(self, name: str, path: Path, cache: ResultCache) -> None:
        self.name = name
        self.tracks = Tracks.load(path)
        self.cache = cache
        digest = hashlib.sha256(self.tracks.descriptors.tobytes())
        digest.update(self.tracks.landmark_of_keypoint.tobytes())
        digest.update(self.tracks.offsets.tobytes())
        self.fingerprint = digest.hexdigest()
        self._trials: dict[int, Trial] = {}

    def check(self) -> None:
        """Raise ValueError if some seed leaves no queries."""
        for seed in SEEDS:
            self._trial(seed)

    def _trial(self, seed: int) -> Trial:
        if seed not in self._trials:
            self._trials[seed] = Trial.from_tracks(self.tracks, self.name, seed)
        return self._trials[seed]

    def of_network(self, training: Training, key: str, outcome: TrainingOutcome) -> float:
        """Precision with float prototypes on the split of the training's seed."""
        mine = key_of(training=key, sequence=self.fingerprint)
        values = self.cache.load(mine)
        if values is None:
            network = outcome.network(training, self.tracks.bits)
            trial = self._trial(training.seed)
            found = precision(trial, lambda d: embed(network, d), (training.dim,))
            values = {"precision": found[training.dim]}
            self.cache.save(mine, values)
        return float(values["precision"])

    def of_methods(
        self, methods: Sequence[MethodChoice], digest: str, threads: int
    ) -> MethodFigures:
        """Precision by method and seed, and bytes a landmark by method."""
        names = [choice.name for choice in methods]
        mine = key_of(methods=names, seeds=SEEDS, encoder=digest, sequence=self.fingerprint)
        values = self.cache.load(mine)
        if values is None:
            options = Options(seeds=SEEDS, pose_frames=0, threads=threads)
            result = evaluate(self.tracks, self.name, methods, options)
            values = {
                "precision": {m.name: m.precision for m in result.methods},
                "bytes": {m.name: float(np.mean(m.bytes_per_landmark)) for m in result.methods},
            }
            self.cache.save(mine, values)
        return MethodFigures(values["precision"], values["bytes"])


def compared(descriptor: str, bits: int, threads: int) -> tuple[list[MethodChoice], str]:
    """The paper's other methods, and the encoder that ships for the descriptor, if one does.

    Returns:
        The methods, and the SHA-256 of the encoder's file ("" without one).
    """
    encoders, digest = _shipped(descriptor, bits)
    listed = {choice.name: choice for choice in choices(encoders, threads=threads)}
    names = [*BASELINES, *(f"protomark-{dim}" for dim in SHIPPED_DIMS)]
    return [listed[name] for name in names if name in listed], digest


def _shipped(descriptor: str, bits: int) -> tuple[list[pm.Encoder], str]:
    import protomark as pm
    from protomark import models

    if descriptor not in models.names():
        return [], ""
    encoder = pm.Encoder.load(descriptor)
    if encoder.bits != bits:
        return [], ""
    return [encoder], hashlib.sha256(models.resolve(descriptor).read_bytes()).hexdigest()
