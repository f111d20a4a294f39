"""Measures precision on the test sequences, of trained networks and other methods."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import protomark as pm
from protomark import models
from protomark.evaluation.methods import MethodChoice, method_choices
from protomark.evaluation.run import EvaluationOptions, evaluate
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.network import embed
from protomark.training.validation import Trial, precision
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.paper.scale import SEEDS, Training
from protomark_bench.paper.trainer import TrainingOutcome

BASELINES = ("unaggregated", "majority", "pca-16-float", "random")
SHIPPED = ("protomark-32", "protomark-16")


class MeasuredSequence:
    """A test sequence, and measurements on it, which are cached.

    Args:
        path: its tracks file.
        cache: cache of the measurements.

    Raises:
        ValueError: there are no queries at some seed.
    """

    def __init__(self, path: Path, cache: ResultCache) -> None:
        self.name = sequence_name(path)
        self.tracks = Tracks.load(path)
        self.cache = cache
        digest = hashlib.sha256(self.tracks.descriptors.tobytes())
        digest.update(self.tracks.landmark_of_keypoint.tobytes())
        digest.update(self.tracks.offsets.tobytes())
        self.fingerprint = digest.hexdigest()
        self._trials = {seed: Trial.from_tracks(self.tracks, self.name, seed) for seed in SEEDS}

    def of_network(self, training: Training, key: str, outcome: TrainingOutcome) -> float:
        """Precision with float prototypes on the split of the training's seed."""

        def measure() -> dict[str, float]:
            network = outcome.network(training, self.tracks.bits)
            trial = self._trials[training.seed]
            found = precision(trial, lambda d: embed(network, d), (training.dim,))
            return {"precision": found[training.dim]}

        found = self.cache.get(key_of(training=key, sequence=self.fingerprint), measure)
        return float(found["precision"])

    def of_methods(
        self, methods: Sequence[MethodChoice], encoder: str, threads: int
    ) -> dict[str, tuple[list[float], float]]:
        """Precision at each seed, and mean bytes per landmark, by method."""
        names = [choice.name for choice in methods]
        key = key_of(methods=names, seeds=SEEDS, encoder=encoder, sequence=self.fingerprint)

        def measure() -> dict[str, tuple[list[float], float]]:
            options = EvaluationOptions(seeds=SEEDS, pose_frames=0, threads=threads)
            found = evaluate(self.tracks, self.name, methods, options).methods
            return {m.name: (m.precision, float(np.mean(m.bytes_per_landmark))) for m in found}

        return self.cache.get(key, measure)


def compared(descriptor: str, bits: int, threads: int) -> tuple[list[MethodChoice], str]:
    """The paper's other methods, and the encoder that ships for the descriptor, if any.

    Returns:
        The methods, and the identity of the encoder ("" without one).
    """
    encoders = [pm.Encoder.load(descriptor)] if descriptor in models.names() else []
    encoders = [encoder for encoder in encoders if encoder.bits == bits]
    listed = {choice.name: choice for choice in method_choices(encoders, threads=threads)}
    methods = [listed[name] for name in (*BASELINES, *SHIPPED) if name in listed]
    return methods, "".join(str(encoder.identity) for encoder in encoders)
