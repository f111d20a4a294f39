"""What each part of the training recipe brings: data, objective, capacity, length.

python benchmarks/training_ablation.py TRACKS... -o FOLDER [--study recipe] [--steps 300]
    [--seeds 1] [--only NAME]

TRACKS are the FREAK (or other) tracks of hololens, caliterra, and, plain and varied, of desk_rpy,
viking, conch and seneca. Trained on the latter four, measured on hololens and caliterra, which are
no test sequences. A finished variant is kept in FOLDER and not trained again. Writes a table and,
for the recipe, the figure of docs/training.md. The study "inputs" needs no varied tracks.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

import protomark as pm
from documents import replace_tables
from keypoint_inputs import with_inputs
from mined_batches import AveragePrecisionLoss, MinedSampler
from protomark.console import progress_bar
from protomark.files import replacing, write_text
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.command import unaggregated_precision
from protomark.training.network import default_hidden, embed
from protomark.training.sampling import Views
from protomark.training.train import Options, Trainer, has_fast_bfloat16, keep_freed_memory
from protomark.training.validation import Trial, precision
from protomark.upright import upright_tracks
from second_order import SecondOrderLoss

DOCUMENT = Path(__file__).parent.parent / "docs" / "training.md"
LEARNED = ("desk_rpy", "viking", "conch", "seneca")
MEASURED = ("hololens", "caliterra")
DIMS = (8, 16, 32, 64)
QUERIES = 5000


@dataclass(frozen=True)
class Variant:
    """One change of the recipe: options that differ, what is learned from, batches and loss.

    `mined` is the share of a batch that `MinedSampler` picks, `inputs` are of `keypoint_inputs`,
    `second_order` is the weight of that term.
    """

    name: str
    group: str
    options: dict[str, object] = field(default_factory=dict)
    sequences: tuple[str, ...] = LEARNED
    varied: bool = True
    upright: bool = False
    inputs: tuple[str, ...] = ()
    mined: float = 0.0
    average_precision: bool = False
    second_order: float = 0.0

    @property
    def learned(self) -> list[str]:
        """The tracks that it is trained on."""
        return [name + ".varied" * self.varied for name in self.sequences]


RECIPE = (
    Variant("the recipe", ""),
    Variant("1 sequence", "data", sequences=LEARNED[:1]),
    Variant("2 sequences", "data", sequences=LEARNED[:2]),
    Variant("no varied copies", "", varied=False),
    Variant("angle and size as inputs (upright)", "", varied=False, upright=True),
    Variant("no bit noise", "data", {"noise": 0.0}),
    Variant("2 views in the support", "objective", {"views": 3, "queries": 3}),
    Variant("batches of 300 landmarks", "objective", {"landmarks": 300}),
    Variant("batches of 2000 landmarks", "objective", {"landmarks": 2000}),
    Variant("batches of mined negatives", "objective", mined=1.0),
    Variant("half of a batch mined negatives", "objective", mined=0.5),
    Variant("average-precision loss", "objective", average_precision=True),
    Variant("second-order term, weight 0.1", "objective", second_order=0.1),
    Variant("second-order term, weight 1", "objective", second_order=1.0),
    Variant("32 alone", "nesting", {"dims": (32,)}),
    Variant("linear", "capacity", {"hidden": ()}),
    Variant("256 hidden units", "capacity", {"hidden": (256,)}),
    Variant("512 hidden units", "capacity", {"hidden": (512,)}),
    Variant("512-256 hidden units", "capacity", {"hidden": (512, 256)}),
    Variant("rate 0.003", "objective", {"learning_rate": 3e-3}),
    Variant("no quantisation before the last step", "objective", {"quantized_share": 0.0}),
    Variant("half the steps", "length", {"steps": 0.5}),
    Variant("twice the steps", "length", {"steps": 2.0}),
)
_PLAIN = Variant("no further input", "", varied=False)
INPUTS = (
    _PLAIN,
    replace(_PLAIN, name="response", inputs=("response",)),
    replace(_PLAIN, name="octave", inputs=("octave",)),
    replace(_PLAIN, name="response and octave", inputs=("response", "octave")),
    replace(_PLAIN, name="size", inputs=("size",)),
)
STUDIES = {"recipe": RECIPE, "inputs": INPUTS}


def kept_codes_precision(trial: Trial, codes: NDArray[np.float32]) -> float:
    """Precision when all codes of the support are kept, none averaged; queries are the last."""
    support, queries = codes[: len(trial.support)], codes[len(trial.support) :]
    norms = (support**2).sum(1)
    right = 0
    for i in range(0, len(queries), 512):
        nearest = (norms - 2 * queries[i : i + 512] @ support.T).argmin(1)
        right += int((trial.landmarks[nearest] == trial.targets[i : i + 512]).sum())
    return right / len(queries)


def run(
    variant: Variant, steps: int, seed: int, tracks: dict[str, Tracks], step: object
) -> dict[str, object]:
    """Train a variant and measure its integer encoder."""
    changes = dict(variant.options)
    share = changes.pop("steps", 1.0)
    assert isinstance(share, float)
    many = round(steps * share)
    options = replace(Options(steps=many, validate_every=many, seed=seed), **changes)  # type: ignore[arg-type]
    learned = [tracks[name] for name in variant.learned]
    measured = [tracks[name] for name in MEASURED]
    plain = [Trial.from_tracks(t, n, 0, QUERIES) for n, t in zip(MEASURED, measured, strict=True)]
    if variant.upright:
        learned, measured = [[upright_tracks(t) for t in each] for each in (learned, measured)]
    if variant.inputs:
        learned, measured = [
            [with_inputs(t, variant.inputs) for t in each] for each in (learned, measured)
        ]
    views = [Views.from_tracks(t, n) for n, t in zip(variant.sequences, learned, strict=True)]
    trials = [Trial.from_tracks(t, n, 0, QUERIES) for n, t in zip(MEASURED, measured, strict=True)]
    trainer = Trainer(views, trials[:1], options, half=has_fast_bfloat16("cpu"))
    if variant.mined:
        trainer.sampler = MinedSampler(trainer, variant.mined, every=max(many // 4, 1))
    if variant.average_precision:
        trainer.loss = AveragePrecisionLoss(options.dims)
    if variant.second_order:
        loss = SecondOrderLoss(options.dims, variant.second_order)
        loss.log_temperature = trainer.loss.log_temperature  # the one that is optimised
        trainer.loss = loss
    trainer.run(step)  # type: ignore[arg-type]
    bits, dims = trainer.network.bits, [d for d in DIMS if d in options.dims]
    found: dict[str, object] = {
        "options": asdict(options),
        "sequences": variant.sequences,
        "multiply_adds": sum(
            a * b for a, b in pairwise([bits, *trainer.network.hidden, options.dims[-1]])
        ),
        "seconds": trainer.seconds,
        "loss": trainer.history[-1].loss,
    }
    encoder = pm.Encoder(
        [{**layer} for layer in trainer.quantized.export()],
        dims=list(options.dims),
        name=variant.name,
        descriptor=tracks[MEASURED[0]].descriptor,
        scale=float(trainer.quantized.scale),
    )
    for trial, raw in zip(trials, plain, strict=True):
        codes = embed(trainer.quantized, np.concatenate([trial.support, trial.queries]))
        found[trial.name] = {
            "unaggregated": unaggregated_precision(raw),
            "prototypes": precision(trial, encoder.encode, dims),
            "codes kept": kept_codes_precision(trial, codes),
        }
    return found


def text(results: dict[str, dict[str, dict]], steps: int, machine: str) -> str:  # type: ignore[type-arg]
    """The table: a row a variant, mean over seeds."""
    head = [f"{s}, {d}" for s in MEASURED for d in (*DIMS, "all codes kept")]
    lines = [
        f"{steps} steps where nothing else is said; {machine}. The last column of a sequence keeps "
        "every code of the support at the greatest length, so that only the encoder loses, not the "
        "mean.",
        "",
        "| what differs | multiply-adds | loss | " + " | ".join(head) + " |",
        "|---|---:|---:|" + "---:|" * len(head),
    ]
    raw, spread = "", 0.0
    for name, seeds in results.items():
        runs = list(seeds.values())
        row = [name, f"{runs[0]['multiply_adds']:,}", f"{np.mean([r['loss'] for r in runs]):.3f}"]
        for s in MEASURED:
            for d in DIMS:
                values = [r[s]["prototypes"].get(str(d)) for r in runs]
                row.append("–" if None in values else f"{np.mean(values):.3f}")
                spread = max(spread, float(np.ptp(values)) if d >= 32 and None not in values else 0)
            row.append(f"{np.mean([r[s]['codes kept'] for r in runs]):.3f}")
        raw = ", ".join(f"{s} {runs[0][s]['unaggregated']:.3f}" for s in MEASURED)
        lines.append("| " + " | ".join(row) + " |")
    lines += ["", f"Raw descriptors, all kept: {raw}."]
    if spread:
        lines[-1] += f" Seeds of a row differ by up to {spread:.3f} at 32 and 64 numbers."
    return "\n".join(lines) + "\n"


def draw(results: dict[str, dict[str, dict]], path: Path) -> None:  # type: ignore[type-arg]
    """Precision against multiply-adds, and against the data."""
    figure = Figure(figsize=(9, 3.6), layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2, sharey=True)
    shades = {16: "#94a3b8", 32: "#0f766e", 64: "#1f2430"}
    names = {v.group: [w.name for w in RECIPE if w.group == v.group] for v in RECIPE}
    for axes, group in ((left, "capacity"), (right, "data")):
        chosen = [n for n in names[group] if n in results and "noise" not in n]
        chosen = [*chosen, "the recipe"]
        for d, colour in shades.items():
            points = []
            for name in chosen:
                if name not in results or "512-256" in name:
                    continue
                runs = list(results[name].values())
                y = np.mean([r[s]["prototypes"][str(d)] for r in runs for s in MEASURED])
                x = runs[0]["multiply_adds"] if group == "capacity" else len(runs[0]["sequences"])
                points.append((x, float(y)))
            points.sort()
            axes.plot(*zip(*points, strict=True), marker="o", color=colour, label=f"{d} numbers")
        axes.grid(color="#e5e7eb")
        axes.spines[["top", "right"]].set_visible(False)
    left.set_xlabel("multiply-adds a descriptor")
    left.set_ylabel("precision, mean of " + " and ".join(MEASURED))
    left.legend()
    right.set_xlabel("training sequences")
    right.set_xticks([1, 2, 4])
    with replacing(path) as file:
        figure.savefig(file, format="svg")


def main() -> None:
    """Train what is missing, then write the document."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("tracks", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--study", choices=list(STUDIES), default="recipe")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", action="append", help="train only this variant; may be repeated")
    asked = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    asked.output.mkdir(parents=True, exist_ok=True)
    tracks = {}
    for path in asked.tracks:
        loaded = Tracks.load(path)
        tracks[sequence_name(path) + ".varied" * bool(loaded.info.get("variants"))] = loaded
    variants = STUDIES[asked.study]
    missing = {*MEASURED, *(name for v in variants for name in v.learned)} - set(tracks)
    if missing:
        parser.error(f"no tracks of {', '.join(sorted(missing))}")
    results: dict[str, dict[str, dict]] = {}  # type: ignore[type-arg]
    with progress_bar() as bar:
        overall = bar.add_task("variants", total=len(variants) * asked.seeds)
        for variant in variants:
            for seed in range(asked.seeds):
                kept = asked.output / f"{variant.name.replace(' ', '_')}.{asked.steps}.{seed}.json"
                if not kept.exists() and asked.only and variant.name not in asked.only:
                    continue
                if not kept.exists():
                    found = run(
                        variant,
                        asked.steps,
                        seed,
                        tracks,
                        lambda done, loss, progress, name=variant.name: bar.update(
                            overall, description=f"{name}: step {done}"
                        ),
                    )
                    write_text(kept, json.dumps(found, indent=1) + "\n")
                results.setdefault(variant.name, {})[str(seed)] = json.loads(kept.read_text())
                bar.advance(overall)
    bits = next(iter(tracks.values())).bits
    seeds = f"{asked.seeds} seed{'s' if asked.seeds > 1 else ''}"
    kind = next(iter(tracks.values())).descriptor
    machine = f"{kind}, {seeds}, hidden units by default {default_hidden(bits, 64)[0]}"
    table = text(results, asked.steps, machine)
    if asked.study == "inputs":
        replace_tables(DOCUMENT, table, "inputs")
        return
    picture = DOCUMENT.parent / "training.svg"
    draw(results, picture)
    caption = "![Precision against multiply-adds and data](training.svg)\n"
    replace_tables(DOCUMENT, table + "\n" + caption)


if __name__ == "__main__":
    main()
