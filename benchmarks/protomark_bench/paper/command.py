"""Runs `protomark reproduce`: trainings, measurements and results."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from protomark.cli.terminal import note, progress_bar
from protomark.progress import tracked
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.data import load_training
from protomark.training.sampling import Views
from protomark.training.train import has_fast_bfloat16, keep_freed_memory
from protomark_bench import machine
from protomark_bench.cache import ResultCache
from protomark_bench.paper.measure import MeasuredSequence, compared
from protomark_bench.paper.results import (
    DepthPoint,
    DimensionCurve,
    MethodRow,
    PaperResults,
    SequenceSize,
)
from protomark_bench.paper.scale import (
    DIMS,
    PAPER_PICK,
    SEEDS,
    TABLE_DIMS,
    Scale,
    Training,
    depth_trainings,
    measured_trainings,
)
from protomark_bench.paper.sequences import assign, find
from protomark_bench.paper.trainer import PaperData, TrainingOutcome
from protomark_bench.paper.workers import Trainings


@dataclass(frozen=True)
class PaperSettings:
    """How a reproduction runs.

    Attributes:
        scale: length and data of the trainings.
        descriptor: descriptor of the tracks.
        jobs: trainings at a time.
        threads: threads of each training.
        roles: names of sequences by the role that the user gave them.
    """

    scale: Scale
    descriptor: str
    jobs: int
    threads: int
    roles: dict[str, Sequence[str]]


def reproduce(data: Sequence[Path], output: Path, settings: PaperSettings) -> PaperResults:
    """Runs the paper's evaluation.

    Args:
        data: tracks files, or folders of them.
        output: folder of the cache.
        settings: see `PaperSettings`.

    Raises:
        FileNotFoundError, ValueError: sequences are missing, broken or too few.
        KeyboardInterrupt: finished results are cached, and the same call continues.
    """
    begin = time.perf_counter()
    keep_freed_memory()
    together = settings.jobs * settings.threads
    found = find(data, settings.descriptor)
    roles = assign(found, settings.scale, settings.roles)
    paths = {role: [found[name] for name in names] for role, names in roles.items()}
    cache = ResultCache(output / "cache")
    training, sizes, descriptor = _load(paths)
    tests = [_open_test(path, cache, descriptor, training.bits) for path in paths["test"]]
    for test in tests:
        t = test.tracks
        counts = (len(t.keyframe_names), len(t.landmark_ids), len(t.observations))
        sizes.append(SequenceSize(test.name, "test", *counts))
    half = has_fast_bfloat16("cpu")
    trainings = Trainings(training, settings.scale, cache, half, settings.jobs, settings.threads)

    outcomes = trainings.run([*depth_trainings(), *measured_trainings(PAPER_PICK)])
    depth = [_point(t, outcomes[t], training.bits) for t in depth_trainings()]
    winner = max(depth, key=lambda point: point.precision).training
    picks = list(dict.fromkeys([PAPER_PICK, winner]))
    outcomes |= trainings.run(measured_trainings(winner))

    torch.set_num_threads(together)
    measured = _measure(tests, picks, outcomes, trainings)
    rows = _rows(tests, picks, measured, descriptor, training.bits, together)
    seconds = {trainings.key(t): o.seconds for t, o in outcomes.items()}
    note(
        f"{trainings.made} trainings ran, {len(seconds) - trainings.made} were cached; "
        f"{(time.perf_counter() - begin) / 60:.1f} minutes in total"
    )
    return PaperResults(
        scale=settings.scale.name,
        max_steps=settings.scale.steps,
        descriptor=descriptor,
        bits=training.bits,
        sequences=sizes,
        depth=depth,
        curves=[
            DimensionCurve(
                pick, {d: {s.name: measured[pick.like(d), s.name] for s in tests} for d in DIMS}
            )
            for pick in picks
        ],
        rows=rows,
        conditions=_conditions(settings, half, list(seconds.values())),
    )


def _load(paths: dict[str, list[Path]]) -> tuple[PaperData, list[SequenceSize], str]:
    """Read and check training and validation sequences."""
    data = load_training(paths["training"], paths["validation"], max_queries=10_000)
    validation = [
        Views.from_tracks(Tracks.load(path), sequence_name(path)) for path in paths["validation"]
    ]
    sources = [("training", s) for s in data.sources]
    sources += [("validation", s) for s in data.validation_sources]
    sizes = [
        SequenceSize(s.name, role, s.keyframes, s.landmarks, s.observations) for role, s in sources
    ]
    training = PaperData(data.views, validation, data.trials, data.bits, data.fingerprint)
    return training, sizes, data.descriptor


def _open_test(path: Path, cache: ResultCache, descriptor: str, bits: int) -> MeasuredSequence:
    test = MeasuredSequence(path, cache)
    if (test.tracks.descriptor, test.tracks.bits) != (descriptor, bits):
        raise ValueError(
            f"{path} has {test.tracks.descriptor} descriptors of {test.tracks.bits} bits, but the "
            f"training tracks have {descriptor} of {bits}: give tracks of one descriptor"
        )
    return test


def _point(training: Training, outcome: TrainingOutcome, bits: int) -> DepthPoint:
    return DepthPoint(
        training,
        training.hidden(bits),
        outcome.precision,
        outcome.validation_loss,
        outcome.best_step,
        outcome.steps,
        outcome.seconds,
    )


def _measure(
    tests: Sequence[MeasuredSequence],
    picks: Sequence[Training],
    outcomes: dict[Training, TrainingOutcome],
    trainings: Trainings,
) -> dict[tuple[Training, str], float]:
    """Precision on the test sequences of every network in the curves and the table."""
    measured = [t for pick in picks for t in measured_trainings(pick)]
    found = {}
    with progress_bar() as progress:
        for training in tracked(measured, progress, "measure networks"):
            for test in tests:
                key = trainings.key(training)
                found[training, test.name] = test.of_network(training, key, outcomes[training])
    return found


def _rows(
    tests: Sequence[MeasuredSequence],
    picks: Sequence[Training],
    measured: dict[tuple[Training, str], float],
    descriptor: str,
    bits: int,
    threads: int,
) -> list[MethodRow]:
    """The rows of the table in the paper's order, followed by rows that the paper lacks."""
    methods, encoder = compared(descriptor, bits, threads)
    by_sequence = {}
    with progress_bar() as progress:
        for test in tracked(tests, progress, "measure other methods"):
            by_sequence[test.name] = test.of_methods(methods, encoder, threads)

    def baseline(name: str, label: str) -> MethodRow:
        size = float(np.mean([found[name][1] for found in by_sequence.values()]))
        precision = {sequence: found[name][0] for sequence, found in by_sequence.items()}
        return MethodRow(name, label, size, precision)

    def prototypes(pick: Training, name: str, label: str) -> list[MethodRow]:
        return [
            MethodRow(
                f"{name}-{dim}",
                f"{dim}-d prototypes{label}",
                4 * dim + 1,
                {t.name: [measured[pick.like(dim, seed), t.name] for seed in SEEDS] for t in tests},
            )
            for dim in TABLE_DIMS
        ]

    rows = [baseline("unaggregated", "Unaggregated")]
    rows += prototypes(PAPER_PICK, "prototypes", "")
    rows += [
        baseline("majority", "Quantised mean"),
        baseline("pca-16-float", "Mean of PCA, 16-d"),
        baseline("random", "Random sample"),
    ]
    for pick in picks[1:]:
        rows += prototypes(pick, "best", ", best on validation")
    rows += [
        baseline(choice.name, f"{choice.label} (ships, int8)")
        for choice in methods
        if choice.family == "protomark"
    ]
    return rows


def _conditions(settings: PaperSettings, half: bool, seconds: list[float]) -> dict[str, str]:
    scale = settings.scale
    end = (
        "; a last fifth at a tenth of the rate at least"
        if scale.steps
        else "; the third such plateau ends a training"
    )
    return {
        "schedule": f"Adam at 0.001, a tenth of it after {scale.patience} epochs of {scale.epoch} "
        f"steps without a lower validation loss{end}",
        "trainings": f"{len(seconds)}, {sum(seconds) / 60:.1f} minutes of one process in total",
        "seeds": "sweeps 0; table " + ", ".join(map(str, SEEDS)),
        "jobs": f"{settings.jobs} training(s) at a time with {settings.threads} thread(s) each, "
        f"matrix products in {'bfloat16' if half else 'float32'}",
        **machine.describe("torch", "numpy"),
        "again": f"`protomark reproduce --scale {scale.name}`, see docs/results/paper.md",
    }
