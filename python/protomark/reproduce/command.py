"""What `protomark reproduce` does: tracks, trainings, measurements, report."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from protomark.console import console, progress_bar, progress_console
from protomark.evaluation.threads import available_threads
from protomark.files import write_text
from protomark.reproduce import figures
from protomark.reproduce.measure import MeasuredSequence, compared
from protomark.reproduce.reading import reading
from protomark.reproduce.report import markdown
from protomark.reproduce.results import Curve, DepthPoint, Results, Row, SequenceFacts, best
from protomark.reproduce.scale import Scale
from protomark.reproduce.sequences import Found, assign, find, tracks_file
from protomark.reproduce.store import Store
from protomark.reproduce.trainer import Material, Outcome
from protomark.reproduce.training import (
    DIMS,
    PAPER_PICK,
    SEEDS,
    TABLE_DIMS,
    Training,
    depth_trainings,
    measured_trainings,
)
from protomark.reproduce.workers import Trainings
from protomark.tracks.file import Tracks
from protomark.training.data import load_training
from protomark.training.sampling import Views
from protomark.training.train import has_fast_bfloat16, keep_freed_memory

OUTPUTS = ("report.md", "report.json", "depth.svg", "depth.png", "dimension.svg", "dimension.png")


@dataclass(frozen=True)
class Settings:
    """How a reproduction runs.

    Attributes:
        scale: how long trainings are, and on what.
        descriptor: of the tracks.
        jobs: trainings at a time.
        threads: threads of each.
        given: role -> names of sequences that the user gave that role.
    """

    scale: Scale
    descriptor: str
    jobs: int
    threads: int
    given: dict[str, Sequence[str]]


def reproduce(
    data: Sequence[Path], output: Path, settings: Settings, json_path: Path | None = None
) -> Results:
    """Run the paper's evaluation and write its report into a folder.

    Args:
        data: tracks files, folders of them, or folders of sequences with images.
        output: folder of the report, the tracks that are made, and what is kept for a next run.
        settings: see `Settings`.
        json_path: where the figures go too.

    Raises:
        FileNotFoundError, ValueError: sequences are missing, broken or too few.
        KeyboardInterrupt: what is finished is kept; the same call goes on.
    """
    begin = time.perf_counter()
    if output.exists() and not output.is_dir():
        raise NotADirectoryError(f"{output}: not a folder, name one for the report with -o")
    if json_path is not None and not json_path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{json_path.parent}: no such folder for --json")
    keep_freed_memory()
    together = settings.jobs * settings.threads
    roles = assign(find(data, settings.descriptor), settings.scale, settings.given)
    output.mkdir(parents=True, exist_ok=True)
    paths = {
        role: [tracks_file(s, settings.descriptor, output / "tracks", together) for s in sequences]
        for role, sequences in roles.items()
    }
    store = Store(output / "kept")
    material, facts, descriptor = _load(roles, paths)
    tests = [
        _measured(sequence, path, store, descriptor, material.bits)
        for sequence, path in zip(roles["test"], paths["test"], strict=True)
    ]
    facts += [_facts(test.name, "test", test.tracks) for test in tests]
    half = has_fast_bfloat16("cpu")
    trainings = Trainings(material, settings.scale, store, half, settings.jobs, settings.threads)

    extra = [t for t in measured_trainings(PAPER_PICK) if t != PAPER_PICK]
    asked = [*depth_trainings(), *extra]
    outcomes = trainings.run(asked, later=len(extra))
    depth = [_point(t, outcomes[t], material.bits) for t in depth_trainings()]
    winner = best(depth).training
    picks = list(dict.fromkeys([PAPER_PICK, winner]))
    outcomes |= trainings.run(measured_trainings(winner))

    torch.set_num_threads(together)
    measured = _measure(tests, picks, outcomes, trainings)
    rows = _rows(tests, picks, measured, descriptor, material.bits, together)
    seconds = {trainings.key(t): o.seconds for t, o in outcomes.items()}
    results = Results(
        scale=settings.scale.name,
        max_steps=settings.scale.steps,
        descriptor=descriptor,
        bits=material.bits,
        sequences=facts,
        depth=depth,
        curves=[
            Curve(pick, {d: {s.name: measured[pick.like(d), s.name] for s in tests} for d in DIMS})
            for pick in picks
        ],
        rows=rows,
        conditions=_conditions(settings, half, list(seconds.values())),
    )
    figures.save(results, output)
    text = json.dumps(results.as_dict(), indent=1) + "\n"
    write_text(output / "report.json", text)
    if json_path is not None:
        write_text(json_path, text)
    write_text(output / "report.md", markdown(results))
    progress_console.print(
        f"{trainings.made} trainings made, {len(seconds) - trainings.made} were there; "
        f"{(time.perf_counter() - begin) / 60:.1f} minutes in all",
        highlight=False,
    )
    return results


def _load(
    roles: dict[str, list[Found]], paths: dict[str, list[Path]]
) -> tuple[Material, list[SequenceFacts], str]:
    """Training and validation sequences, checked."""
    data = load_training(paths["training"], paths["validation"], max_queries=10_000)
    validation = [
        Views.from_tracks(Tracks.load(path), found.name)
        for found, path in zip(roles["validation"], paths["validation"], strict=True)
    ]
    material = Material(data.views, validation, data.trials, data.bits, data.fingerprint)
    sources = [("training", s) for s in data.sources]
    sources += [("validation", s) for s in data.validation_sources]
    facts = [
        SequenceFacts(s.name, role, s.keyframes, s.landmarks, s.observations) for role, s in sources
    ]
    return material, facts, data.descriptor


def _facts(name: str, role: str, tracks: Tracks) -> SequenceFacts:
    return SequenceFacts(
        name,
        role,
        len(tracks.keyframe_names),
        len(tracks.landmark_ids),
        len(tracks.observations),
    )


def _measured(
    sequence: Found, path: Path, store: Store, descriptor: str, bits: int
) -> MeasuredSequence:
    measured = MeasuredSequence(sequence.name, path, store)
    if (measured.tracks.descriptor, measured.tracks.bits) != (descriptor, bits):
        raise ValueError(
            f"{path}: {measured.tracks.descriptor} descriptors of {measured.tracks.bits} bits, but "
            f"the training tracks have {descriptor} of {bits}; give tracks of one descriptor"
        )
    measured.check()
    return measured


def _point(training: Training, outcome: Outcome, bits: int) -> DepthPoint:
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
    outcomes: dict[Training, Outcome],
    trainings: Trainings,
) -> dict[tuple[Training, str], float]:
    """Precision on test of every network that the curves and the table ask for."""
    wanted = [t for pick in picks for t in measured_trainings(pick)]
    found = {}
    with progress_bar() as bar:
        task = bar.add_task("measuring networks", total=len(wanted) * len(tests))
        for training in wanted:
            for test in tests:
                found[training, test.name] = test.of_network(
                    training, trainings.key(training), outcomes[training]
                )
                bar.advance(task)
    return found


def _rows(
    tests: Sequence[MeasuredSequence],
    picks: Sequence[Training],
    measured: dict[tuple[Training, str], float],
    descriptor: str,
    bits: int,
    threads: int,
) -> list[Row]:
    """The table, in the paper's order; what the paper does not have comes last."""
    methods, digest = compared(descriptor, bits, threads)
    by_sequence = {}
    with progress_bar() as bar:
        task = bar.add_task("measuring other methods", total=len(tests))
        for test in tests:
            by_sequence[test.name] = test.of_methods(methods, digest, threads)
            bar.advance(task)

    def baseline(name: str, label: str) -> Row:
        found = by_sequence.values()
        return Row(
            name,
            label,
            float(np.mean([one.bytes_per_landmark[name] for one in found])),
            {sequence: one.precision[name] for sequence, one in by_sequence.items()},
        )

    def prototypes(pick: Training, dim: int, name: str, label: str) -> Row:
        precision = {
            test.name: [measured[pick.like(dim, seed), test.name] for seed in SEEDS]
            for test in tests
        }
        return Row(f"{name}-{dim}", f"{dim}-d prototypes{label}", 4 * dim + 1, precision)

    rows = [baseline("unaggregated", "Unaggregated")]
    rows += [prototypes(PAPER_PICK, dim, "prototypes", "") for dim in TABLE_DIMS]
    rows += [
        baseline("majority", "Quantised mean"),
        baseline("pca-16-float", "Mean of PCA, 16-d"),
        baseline("random", "Random sample"),
    ]
    for pick in picks[1:]:
        rows += [prototypes(pick, dim, "best", ", best on validation") for dim in TABLE_DIMS]
    rows += [
        baseline(choice.name, f"{choice.label} (ours, int8)")
        for choice in methods
        if choice.family == "protomark"
    ]
    return rows


def _conditions(settings: Settings, half: bool, seconds: list[float]) -> dict[str, str]:
    import protomark

    return {
        "schedule": f"Adam at 0.001, a tenth of it after {settings.scale.patience} epochs of "
        f"{settings.scale.epoch} steps without a lower validation loss"
        + (
            "; a last fifth at a tenth of the rate at least"
            if settings.scale.steps
            else "; the third such plateau ends a training"
        ),
        "trainings": f"{len(seconds)}, {sum(seconds) / 60:.1f} minutes of one process in all",
        "seeds": "sweeps 0; table " + ", ".join(map(str, SEEDS)),
        "machine": f"{platform.machine()}, {platform.system()}, {available_threads()} cores, "
        f"{settings.jobs} training(s) at a time with {settings.threads} thread(s) each, matrix "
        f"products of the training in {'bfloat16' if half else 'float32'}",
        "versions": f"protomark {protomark.__version__}, PyTorch {torch.__version__}, NumPy "
        f"{np.__version__}, Python {platform.python_version()}",
        "again": "`protomark reproduce --scale " + settings.scale.name + "`, docs/reproduction.md",
    }


def print_summary(results: Results, output: Path) -> None:
    """The table and what it says, on stdout."""
    from rich.box import SIMPLE_HEAD
    from rich.markdown import Markdown
    from rich.table import Table

    table = Table(
        "method",
        title=f"Mean of {', '.join(results.names('test'))}",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    for head in ("bytes", "precision", "of un-\naggreg.", "paper", "of un-\naggreg."):
        table.add_column(head, justify="right", no_wrap=True)
    for row in results.rows:
        theirs: tuple[Any, Any] = ("–", "–")
        if row.paper is not None:
            whole = results.row("unaggregated").paper or 1.0
            theirs = (f"{row.paper:.3f}", f"{row.paper / whole:.3f}")
        table.add_row(
            row.label,
            f"{row.bytes_per_landmark:,.0f}",
            f"{row.mean:.3f} ±{row.spread:.3f}",
            f"{results.ratio(row):.3f}",
            *theirs,
        )
    console.print(table)
    console.print(Markdown("\n".join(f"- {text}" for text in reading(results))))
    console.print(f"{output / 'report.md'}", highlight=False, soft_wrap=True)


def explain_interruption(output: Path) -> None:
    """What to do after Ctrl-C, on stderr."""
    progress_console.print(
        f"stopped; finished tracks and trainings are kept in {output}, and the same command goes "
        "on after them",
        highlight=False,
        soft_wrap=True,
    )
