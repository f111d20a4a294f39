"""Recall of approximate search: stated and true, and through ten rounds of updates.

python benchmarks/index_recall.py TRACKS... --json FILE --plot FILE.svg [--dim 32]

Each tracks file is split as `protomark evaluate` does: a random 90 % of the keyframes build the
map, what the others saw asks. The last map is that of all files together, each with its own ids. A
query counts as found where the nearest landmark of the exact search, or one as near, comes first.

Rounds: each sequence's observations come in the order of its keyframes, in ten parts. Drift: one
half of the sequences is exchanged for the other. The cells are learned in the first round and never
again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.evaluation.protocol import split
from protomark.tracks.file import Tracks

RECALLS = (0.8, 0.9, 0.95, 0.98, 0.99)
ROUND_RECALL = 0.98
ROUNDS = 10
MAX_QUERIES = 2000


@dataclass
class Sequence:
    """Codes of what builds a map and of what asks it.

    Attributes:
        landmarks, codes: observations of the support, in the order of keyframes; (n,), (n, dim).
        seen: codes of held-out keypoints whose landmark is in the map, (q, dim).
        frames: codes of held-out keypoints of all kinds, as whole frames bring them, (q, dim).
    """

    landmarks: NDArray[np.int64]
    codes: NDArray[np.int8]
    seen: NDArray[np.int8]
    frames: NDArray[np.int8]


def read(tracks: Tracks, encoder: pm.Encoder, dim: int, first_id: int) -> Sequence:
    """The split of one file; landmark ids count from `first_id`."""
    part = split(tracks, 0)
    rng = np.random.default_rng(0)

    def encoded(rows: NDArray[np.int64]) -> NDArray[np.int8]:
        return encoder.encode(tracks.descriptors[rows], dim=dim)

    def some(rows: NDArray[np.int64]) -> NDArray[np.int64]:
        return rng.permutation(rows)[:MAX_QUERIES]

    frames = [np.arange(tracks.offsets[i], tracks.offsets[i + 1]) for i in part.query_keyframes]
    return Sequence(
        tracks.landmark_of_keypoint[part.support_rows] + first_id,
        encoded(part.support_rows),
        encoded(some(part.query_rows)),
        encoded(some(np.concatenate(frames))),
    )


def together(sequences: list[Sequence]) -> Sequence:
    """All of them in one map."""
    return Sequence(
        np.concatenate([s.landmarks for s in sequences]),
        np.concatenate([s.codes for s in sequences]),
        np.concatenate([s.seen for s in sequences]),
        np.concatenate([s.frames for s in sequences]),
    )


def recall(
    scene: pm.PrototypeMap, queries: NDArray[np.int8], stated: float | None, probes: int | None
) -> float:
    """Share of queries whose nearest landmark is found."""
    exact = scene.search_codes(queries, k=1)[1]
    found = scene.search_codes(queries, k=1, recall=stated, probes=probes)[1]
    return float(np.mean(found <= exact))


def fewest_probes(scene: pm.PrototypeMap, queries: NDArray[np.int8], wanted: float) -> int:
    """The fewest cells that truly bring a recall."""
    low, high = 1, scene.index_cells
    while low < high:
        middle = (low + high) // 2
        if recall(scene, queries, None, middle) >= wanted:
            high = middle
        else:
            low = middle + 1
    return low


def stated_and_true(
    scene: pm.PrototypeMap, seen: NDArray[np.int8], frames: NDArray[np.int8]
) -> list[dict[str, float]]:
    """For each recall what it costs, what it brings, and what it would have had to cost."""
    return [
        {
            "stated": stated,
            "probes": scene.probes(stated),
            "seen": recall(scene, seen, stated, None),
            "frames": recall(scene, frames, stated, None),
            "fewest_probes_frames": fewest_probes(scene, frames, stated),
        }
        for stated in RECALLS
    ]


def after(scene: pm.PrototypeMap, number: int, frames: NDArray[np.int8]) -> dict[str, float]:
    """What a round has left."""
    return {
        "round": number,
        "landmarks": len(scene),
        "cells": scene.index_cells,
        "probes": scene.probes(ROUND_RECALL),
        "recall": recall(scene, frames, ROUND_RECALL, None),
    }


def rounds(encoder: pm.Encoder, dim: int, sequences: list[Sequence]) -> list[dict[str, float]]:
    """Recall after each tenth of every sequence."""
    scene = pm.PrototypeMap(encoder, dim)
    frames = together(sequences).frames
    result = []
    for i in range(ROUNDS):
        for s in sequences:
            part = np.array_split(np.arange(len(s.landmarks)), ROUNDS)[i]
            scene.add_codes(s.landmarks[part], s.codes[part])
        if i == 0:
            scene.build_index()
        result.append(after(scene, i + 1, frames))
    return result


def drift(encoder: pm.Encoder, dim: int, sequences: list[Sequence]) -> list[dict[str, float]]:
    """Recall while the landmarks of half the sequences turn into those of the other half.

    Observations of one half are taken back, a ninth of the landmarks a round, and those of the
    other half take their places; queries change in the same measure.
    """
    old, new = together(sequences[0::2]), together(sequences[1::2])
    scene = pm.PrototypeMap(encoder, dim)
    scene.add_codes(old.landmarks, old.codes)
    scene.build_index()
    result = [after(scene, 1, old.frames)]
    gone = np.random.default_rng(0).integers(1, ROUNDS, old.landmarks.max() % (1 << 32) + 1)
    come = np.random.default_rng(1).integers(1, ROUNDS, new.landmarks.max() % (1 << 32) + 1)
    for i in range(1, ROUNDS):
        leaves = gone[old.landmarks % (1 << 32) % len(gone)] == i
        enters = come[new.landmarks % (1 << 32) % len(come)] == i
        scene.add_codes(new.landmarks[enters], new.codes[enters])
        scene.remove_codes(old.landmarks[leaves], old.codes[leaves])
        share = i / (ROUNDS - 1)
        frames = np.concatenate(
            [
                old.frames[: round(len(old.frames) * (1 - share))],
                new.frames[: round(len(new.frames) * share)],
            ]
        )
        result.append(after(scene, i + 1, frames))
    return result


def draw(facts: dict[str, Any], file: Path) -> None:
    """True over stated recall of every map, and recall over the rounds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for row in facts["maps"]:
        joined = row["sequence"] == "all"
        left.plot(
            [r["stated"] for r in row["recalls"]],
            [r["frames"] for r in row["recalls"]],
            color="#0f766e" if joined else "#9ca3af",
            linewidth=2 if joined else 1,
            marker="o",
            markersize=4 if joined else 2,
            label="all sequences, one map" if joined else None,
        )
    left.plot([0.8, 1], [0.8, 1], color="#1f2430", linewidth=0.8, linestyle=":")
    left.set(xlabel="stated recall", ylabel="true recall, held-out frames")
    left.legend(frameon=False)
    for name, label, colour in (
        ("rounds", "ten parts of the tracks", "#0f766e"),
        ("drift", "other sequences take over", "#b45309"),
    ):
        rows = facts[name]
        right.plot(
            [r["round"] for r in rows],
            [r["recall"] for r in rows],
            color=colour,
            marker="o",
            markersize=4,
            label=label,
        )
    right.axhline(ROUND_RECALL, color="#1f2430", linewidth=0.8, linestyle=":")
    right.set(xlabel="round (cells learned after the first)", ylim=(0.9, 1.001))
    right.set_ylabel(f"true recall at {ROUND_RECALL}")
    right.legend(frameon=False, loc="lower right")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    sequences: dict[str, Sequence] = {}
    encoder: pm.Encoder | None = None
    for i, file in enumerate(asked.tracks):
        tracks = Tracks.load(file)
        encoder = encoder or pm.Encoder.load(tracks.descriptor)
        sequences[file.name.split(".")[0]] = read(tracks, encoder, asked.dim, i << 32)
    assert encoder is not None
    sequences["all"] = together(list(sequences.values()))

    facts: dict[str, Any] = {"encoder": encoder.name, "dim": asked.dim, "maps": []}
    for name, sequence in sequences.items():
        scene = pm.PrototypeMap(encoder, asked.dim)
        scene.add_codes(sequence.landmarks, sequence.codes)
        scene.build_index()
        recalls = stated_and_true(scene, sequence.seen, sequence.frames)
        facts["maps"].append(
            {
                "sequence": name,
                "landmarks": len(scene),
                "cells": scene.index_cells,
                "recalls": recalls,
            }
        )
        print(f"{name}: {len(scene):,} landmarks, {scene.index_cells:,} cells")
        for row in recalls:
            print(
                f"  stated {row['stated']:.2f}: {row['probes']:4.0f} probes, true "
                f"{row['seen']:.3f} (landmarks), {row['frames']:.3f} (whole frames); "
                f"{row['fewest_probes_frames']:4.0f} would do"
            )
    parts = [sequence for name, sequence in sequences.items() if name != "all"]
    facts["rounds"] = rounds(encoder, asked.dim, parts)
    facts["drift"] = drift(encoder, asked.dim, parts)
    for name in ("rounds", "drift"):
        print(name)
        for row in facts[name]:
            print(
                f"  {row['round']:2.0f}: {row['landmarks']:7,.0f} landmarks, recall "
                f"{row['recall']:.3f} with {row['probes']:.0f} of {row['cells']:.0f} cells"
            )
    if asked.json:
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")
    if asked.plot:
        draw(facts, asked.plot)


if __name__ == "__main__":
    main()
