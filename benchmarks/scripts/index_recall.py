"""Measures the recall of approximate search: stated and true, and through ten rounds of updates.

python benchmarks/scripts/index_recall.py TRACKS... --plot FILE.svg [--dim 32]

Each tracks file is split as `protomark evaluate` does: a random 90 % of the keyframes build the
map, what the others saw asks. The last map is that of all files together, each with its own ids. A
query counts as found where the nearest landmark of the exact search, or one as near, comes first.

Rounds: each sequence's observations come in the order of its keyframes, in ten parts. Drift: one
half of the sequences replaces the other. Inverted lists are learned in the first round and never
again. Prints the tables of docs/results/large-maps.md, and how far observations are from their
landmark's prototype, as a share of the variance of prototypes: the core moves its test queries by
as much.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.evaluation.protocol import split
from protomark.tracks.file import Tracks
from protomark_bench import plot
from protomark_bench.report import ReportTable

RECALLS = (0.8, 0.9, 0.95, 0.98, 0.99)
ROUND_RECALL = 0.98
ROUNDS = 10
MAX_QUERIES = 2000


@dataclass
class CodedSequence:
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

    @property
    def spread(self) -> float:
        """Mean squared distance of an observation to the mean of its landmark's others."""
        order = np.argsort(self.landmarks, kind="stable")
        codes = self.codes[order].astype(np.float64)
        ids, starts, counts = np.unique(
            self.landmarks[order], return_index=True, return_counts=True
        )
        sums = np.add.reduceat(codes, starts, axis=0)
        landmark = np.repeat(np.arange(len(ids)), counts)
        enough = counts[landmark] >= 3
        own, code = landmark[enough], codes[enough]
        others = (sums[own] - code) / (counts[own] - 1)[:, None]
        variance = (sums / counts[:, None]).var(axis=0).sum()
        return float(np.square(code - others).sum(axis=1).mean() / variance)


def read(tracks: Tracks, encoder: pm.Encoder, dim: int, first_id: int) -> CodedSequence:
    """The split of one file; landmark ids count from `first_id`."""
    part = split(tracks, 0)
    rng = np.random.default_rng(0)

    def encode(rows: NDArray[np.int64]) -> NDArray[np.int8]:
        return encoder.encode(tracks.descriptors[rows], dim=dim)

    def draw(rows: NDArray[np.int64]) -> NDArray[np.int8]:
        return encode(rng.permutation(rows)[:MAX_QUERIES])

    frames = [np.arange(tracks.offsets[i], tracks.offsets[i + 1]) for i in part.query_keyframes]
    return CodedSequence(
        tracks.landmark_of_keypoint[part.support_rows] + first_id,
        encode(part.support_rows),
        draw(part.query_rows),
        draw(np.concatenate(frames)),
    )


def together(sequences: list[CodedSequence]) -> CodedSequence:
    """All of them in one map."""
    return CodedSequence(
        np.concatenate([s.landmarks for s in sequences]),
        np.concatenate([s.codes for s in sequences]),
        np.concatenate([s.seen for s in sequences]),
        np.concatenate([s.frames for s in sequences]),
    )


def recall(
    scene: pm.PrototypeMap, queries: NDArray[np.int8], stated: float | None, nprobe: int | None
) -> float:
    """Share of queries whose nearest landmark is found."""
    exact = scene.search_codes(queries, k=1)[1]
    found = scene.search_codes(queries, k=1, recall=stated, nprobe=nprobe)[1]
    return float(np.mean(found <= exact))


def least_nprobe(scene: pm.PrototypeMap, queries: NDArray[np.int8], wanted: float) -> int:
    """The fewest inverted lists that truly bring a recall."""
    low, high = 1, scene.nlist
    while low < high:
        middle = (low + high) // 2
        if recall(scene, queries, None, middle) >= wanted:
            high = middle
        else:
            low = middle + 1
    return low


def rounds(
    encoder: pm.Encoder, dim: int, sequences: list[CodedSequence]
) -> list[tuple[int, float]]:
    """Landmarks and recall after each tenth of every sequence."""
    scene = pm.PrototypeMap(encoder, dim)
    frames = together(sequences).frames
    result = []
    for i in range(ROUNDS):
        for s in sequences:
            part = np.array_split(np.arange(len(s.landmarks)), ROUNDS)[i]
            scene.add_codes(s.landmarks[part], s.codes[part])
        if i == 0:
            scene.build_index()
        result.append((len(scene), recall(scene, frames, ROUND_RECALL, None)))
    return result


def drift(encoder: pm.Encoder, dim: int, sequences: list[CodedSequence]) -> list[tuple[int, float]]:
    """Landmarks and recall while half the sequences are replaced by the other half.

    Each round subtracts a ninth of the landmarks of one half and adds a ninth of those of the
    other; queries change in the same measure.
    """
    old, new = together(sequences[0::2]), together(sequences[1::2])
    scene = pm.PrototypeMap(encoder, dim)
    scene.add_codes(old.landmarks, old.codes)
    scene.build_index()
    result = [(len(scene), recall(scene, old.frames, ROUND_RECALL, None))]

    def round_of(landmarks: NDArray[np.int64], seed: int) -> NDArray[np.int64]:
        ids, inverse = np.unique(landmarks, return_inverse=True)
        return np.random.default_rng(seed).integers(1, ROUNDS, len(ids))[inverse]

    leaves, enters = round_of(old.landmarks, 0), round_of(new.landmarks, 1)
    for i in range(1, ROUNDS):
        scene.add_codes(new.landmarks[enters == i], new.codes[enters == i])
        scene.subtract_codes(old.landmarks[leaves == i], old.codes[leaves == i])
        share = i / (ROUNDS - 1)
        frames = np.concatenate(
            [
                old.frames[: round(len(old.frames) * (1 - share))],
                new.frames[: round(len(new.frames) * share)],
            ]
        )
        result.append((len(scene), recall(scene, frames, ROUND_RECALL, None)))
    return result


def main() -> None:
    """Measures, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--dim", type=int, default=32)
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    encoder = pm.Encoder.load(Tracks.load(asked.tracks[0]).descriptor)
    parts = {
        file.name.split(".")[0]: read(Tracks.load(file), encoder, asked.dim, i << 32)
        for i, file in enumerate(asked.tracks)
    }
    rows, curves = [], []
    for name, s in {**parts, "all": together(list(parts.values()))}.items():
        scene = pm.PrototypeMap(encoder, asked.dim)
        scene.add_codes(s.landmarks, s.codes)
        scene.build_index()
        trues = [recall(scene, s.frames, stated, None) for stated in RECALLS]
        for stated, true in zip(RECALLS, trues, strict=True):
            least = least_nprobe(scene, s.frames, stated)
            seen = recall(scene, s.seen, stated, None)
            cells = [f"{scene.nprobe(stated)} of {scene.nlist}", f"{seen:.3f}"]
            rows.append([name, f"{stated:.2f}", *cells, f"{true:.3f}", str(least)])
        color = plot.TEAL if name == "all" else plot.MUTED
        label = "all sequences, one map" if name == "all" else ""
        curves.append(plot.Series(label, RECALLS, trues, color))
        print(f"{name}: observations lie {s.spread:.2f} of the variance from their prototype")
    heads = ("map", "stated", "nprobe", "true, landmarks in the map", "true, whole frames")
    print(ReportTable((*heads, "least nprobe (frames)"), rows).markdown())
    sequences = list(parts.values())
    steps = {
        "ten parts of the tracks": rounds(encoder, asked.dim, sequences),
        "other sequences take over": drift(encoder, asked.dim, sequences),
    }
    rows = [
        [name, *(f"{true:.3f} ({landmarks:,})" for landmarks, true in found)]
        for name, found in steps.items()
    ]
    numbers = [str(i + 1) for i in range(ROUNDS)]
    print(ReportTable(["recall (landmarks) after round", *numbers], rows).markdown())
    if asked.plot:
        curves.append(plot.Series("", (0.8, 1), (0.8, 1), plot.INK, ":", 0.8))
        lines = [
            plot.Series(name, range(1, ROUNDS + 1), [true for _, true in found], color)
            for (name, found), color in zip(steps.items(), (plot.BLUE, plot.AMBER), strict=True)
        ]
        levels = [(ROUND_RECALL, "", plot.INK)]
        figure = plot.draw_lines(
            [
                plot.Panel("", "stated recall", "true recall, held-out frames", curves),
                plot.Panel(
                    "",
                    "round (inverted lists learned in the first)",
                    f"true recall at {ROUND_RECALL}",
                    lines,
                    levels=levels,
                    bottom=0.9,
                    top=1.001,
                ),
            ]
        )
        plot.save_svg(figure, asked.plot, "benchmarks/scripts/index_recall.py")


if __name__ == "__main__":
    main()
