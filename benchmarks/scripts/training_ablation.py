"""Measures the effect of each part of the training recipe: data, objective, capacity, length.

python benchmarks/scripts/training_ablation.py TRACKS... -o FOLDER [--steps 300] [--only NAME]

TRACKS are the FREAK (or other) tracks of hololens, caliterra, and, plain and augmented, of
desk_rpy, viking, conch and seneca. The script trains on the latter four and measures on hololens
and caliterra, which are no test sequences. FOLDER caches finished trainings. Writes
docs/results/training.md and its plot.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import protomark as pm
from protomark.cli.terminal import progress_bar
from protomark.files import write_text
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.encoder import binary_precision
from protomark.training.network import embed
from protomark.training.sampling import Views
from protomark.training.train import (
    Trainer,
    TrainingOptions,
    has_fast_bfloat16,
    keep_freed_memory,
)
from protomark.training.validation import Trial, precision
from protomark_bench import plot
from protomark_bench.cache import ResultCache, key_of
from protomark_bench.report import ReportTable, number

PAGE = Path(__file__).parents[2] / "docs" / "results" / "training.md"
LEARNED = ("desk_rpy", "viking", "conch", "seneca")
MEASURED = ("hololens", "caliterra")
DIMS = (8, 16, 32, 64)
QUERIES = 5000


@dataclass(frozen=True)
class RecipeChange:
    """One change of the recipe: options and training data that differ.

    Attributes:
        name: row of the table.
        options: fields of `TrainingOptions` that differ; "steps" is a factor.
        group: "capacity" or "data" if the plot shows it.
        sequences: training sequences.
        augmented: whether to train on their augmented tracks.
        upright: whether angle and size are further inputs.
    """

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    group: str = ""
    sequences: tuple[str, ...] = LEARNED
    augmented: bool = True
    upright: bool = False


CHANGES = (
    RecipeChange("the recipe"),
    RecipeChange("1 sequence", group="data", sequences=LEARNED[:1]),
    RecipeChange("2 sequences", group="data", sequences=LEARNED[:2]),
    RecipeChange("no augmentation", augmented=False),
    RecipeChange("angle and size as inputs (upright)", augmented=False, upright=True),
    RecipeChange("no bit noise", {"noise": 0.0}),
    RecipeChange("2 views in the support", {"views": 3, "queries": 3}),
    RecipeChange("batches of 300 landmarks", {"landmarks": 300}),
    RecipeChange("batches of 2000 landmarks", {"landmarks": 2000}),
    RecipeChange("32 alone", {"dims": (32,)}),
    RecipeChange("linear", {"hidden": ()}, "capacity"),
    RecipeChange("256 hidden units", {"hidden": (256,)}, "capacity"),
    RecipeChange("512 hidden units", {"hidden": (512,)}, "capacity"),
    RecipeChange("512-256 hidden units", {"hidden": (512, 256)}),
    RecipeChange("rate 0.003", {"learning_rate": 3e-3}),
    RecipeChange("no quantisation before the last step", {"quantized_share": 0.0}),
    RecipeChange("half the steps", {"steps": 0.5}),
    RecipeChange("twice the steps", {"steps": 2.0}),
)


def precision_of_all_codes(trial: Trial, codes: NDArray[np.float32]) -> float:
    """Precision with all codes of the support instead of means; the queries' codes come last."""
    support, queries = codes[: len(trial.support)], codes[len(trial.support) :]
    norms = (support**2).sum(1)
    right = 0
    for i in range(0, len(queries), 512):
        nearest = (norms - 2 * queries[i : i + 512] @ support.T).argmin(1)
        right += int((trial.landmarks[nearest] == trial.targets[i : i + 512]).sum())
    return right / len(queries)


def train(change: RecipeChange, steps: int, tracks: dict[str, Tracks]) -> dict[str, Any]:
    """Trains with a change and measures the integer encoder."""
    changes = dict(change.options)
    total = round(steps * changes.pop("steps", 1.0))
    options = replace(TrainingOptions(steps=total, validate_every=total, seed=0), **changes)
    learned = [tracks[name + ".augmented" * change.augmented] for name in change.sequences]
    measured = [tracks[name] for name in MEASURED]
    plain = [Trial.from_tracks(t, n, 0, QUERIES) for n, t in zip(MEASURED, measured, strict=True)]
    if change.upright:
        learned, measured = [[t.upright() for t in each] for each in (learned, measured)]
    views = [Views.from_tracks(t, n) for n, t in zip(change.sequences, learned, strict=True)]
    trials = [Trial.from_tracks(t, n, 0, QUERIES) for n, t in zip(MEASURED, measured, strict=True)]
    trainer = Trainer(views, trials[:1], options, half=has_fast_bfloat16("cpu"))
    trainer.run(lambda done, loss, progress: None)
    network, dims = trainer.network, [d for d in DIMS if d in options.dims]
    encoder = pm.Encoder(
        [{**layer} for layer in trainer.quantized.export()],
        dims=list(options.dims),
        name=change.name,
        descriptor=tracks[MEASURED[0]].descriptor,
        scale=float(trainer.quantized.scale),
    )
    found: dict[str, Any] = {
        "multiply_adds": sum(a * b for a, b in pairwise(network.widths)),
        "loss": trainer.history[-1].loss,
    }
    for trial, raw in zip(trials, plain, strict=True):
        codes = embed(trainer.quantized, np.concatenate([trial.support, trial.queries]))
        by_dim = precision(trial, encoder.encode, dims)
        found[trial.name] = {
            "unaggregated": binary_precision(raw)[0],
            "prototypes": {str(dim): by_dim[dim] for dim in dims},
            "all codes": precision_of_all_codes(trial, codes),
        }
    return found


def table(results: dict[str, dict[str, Any]]) -> ReportTable:
    """A row per change."""
    rows = [
        [
            name,
            f"{found['multiply_adds']:,}",
            f"{found['loss']:.3f}",
            *(
                cell
                for s in MEASURED
                for cell in (
                    *(number(found[s]["prototypes"].get(str(d))) for d in DIMS),
                    f"{found[s]['all codes']:.3f}",
                )
            ),
        ]
        for name, found in results.items()
    ]
    heads = [f"{s}, {d}" for s in MEASURED for d in (*DIMS, "all codes")]
    return ReportTable(["what differs", "multiply-adds", "loss", *heads], rows)


def draw(results: dict[str, dict[str, Any]], path: Path) -> None:
    """Precision against multiply-adds, and against the data."""
    panels = []
    for group, x_label in (
        ("capacity", "multiply-adds per descriptor"),
        ("data", "training sequences"),
    ):
        chosen = [c for c in CHANGES if c.name in results and c.group in ("", group)]
        chosen = [c for c in chosen if c.group or c.name == "the recipe"]
        series = []
        for dim, color in ((16, plot.MUTED), (32, plot.TEAL), (64, plot.INK)):
            points = sorted(
                (
                    results[c.name]["multiply_adds"] if group == "capacity" else len(c.sequences),
                    float(np.mean([results[c.name][s]["prototypes"][str(dim)] for s in MEASURED])),
                )
                for c in chosen
            )
            x, y = [p[0] for p in points], [p[1] for p in points]
            series.append(plot.Series(f"{dim} numbers", x, y, color))
        panels.append(
            plot.Panel("", x_label, f"precision, mean of {' and '.join(MEASURED)}", series)
        )
    plot.save_svg(plot.draw_lines(panels), path, "benchmarks/scripts/training_ablation.py")


def main() -> None:
    """Trains the changes that the cache lacks, then writes the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=300, help="default: 300")
    parser.add_argument("--only", action="append", help="train only this change; may be repeated")
    args = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    tracks = {}
    for path in args.tracks:
        loaded = Tracks.load(path)
        tracks[sequence_name(path) + ".augmented" * bool(loaded.info.get("augmentations"))] = loaded
    cache = ResultCache(args.output)
    results: dict[str, dict[str, Any]] = {}
    with progress_bar() as progress:
        for done, change in enumerate(CHANGES):
            progress(f"train, {change.name}", done, len(CHANGES))
            key = key_of(name=change.name, steps=args.steps, tracks=sorted(tracks))
            found = cache.load(key)
            if found is None and (not args.only or change.name in args.only):
                found = train(change, args.steps, tracks)
                cache.save(key, found)
            if found is not None:
                results[change.name] = found
    raw = {s: next(iter(results.values()))[s]["unaggregated"] for s in MEASURED}
    text = (
        "# What each part of the training recipe brings\n\n"
        "Written by `benchmarks/scripts/training_ablation.py`; [training](../training.md) says "
        f"what to read from it. {tracks[MEASURED[0]].descriptor.upper()}, one seed, {args.steps} "
        "steps where nothing else is said. The last column of a sequence keeps every code of the "
        "support at the greatest length, so that only the encoder loses, not the mean. Raw "
        f"descriptors, all kept: {', '.join(f'{s} {p:.3f}' for s, p in raw.items())}.\n\n"
    )
    write_text(PAGE, f"{text}{table(results).markdown()}\n\n![Precision](training.svg)\n")
    draw(results, PAGE.with_suffix(".svg"))


if __name__ == "__main__":
    main()
