"""Measures the recall of approximate search: stated and true, and over ten rounds of updates.

python benchmarks/scripts/index_recall.py TRACKS... --plot FILE.svg [--dim 32]

The script splits each tracks file as `protomark evaluate` does: a random 90 % of the keyframes
build the map, and the observations of the others are the queries. The last map contains the
landmarks of all files. A query counts as found if the first result is as near as the nearest
landmark of the exact search.

Rounds: each sequence adds its observations in the order of its keyframes, in ten parts. Drift: one
half of the sequences replaces the other. The index learns its inverted lists only in the first
round. Prints the tables of docs/results/large-maps.md, and the distance of observations from their
landmark's prototype as a share of the variance of prototypes: the core moves its test queries by as
much.
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
    """Codes that build a map, and codes that query it.

    Attributes:
        landmarks, codes: observations that build the map, by keyframe; (n,), (n, dim).
        seen: codes of held-out keypoints whose landmark is in the map, (q, dim).
        frames: codes of all held-out keypoints, with or without a landmark in the map, (q, dim).
    """

    landmarks: NDArray[np.int64]
    codes: NDArray[np.int8]
    seen: NDArray[np.int8]
    frames: NDArray[np.int8]

    @property
    def spread(self) -> float:
        """Mean squared distance of an observation to the mean of its landmark's other observations.

        It is a share of the variance of the landmarks' means.
        """
        order = np.argsort(self.landmarks, kind="stable")
        codes = self.codes[order].astype(np.float64)
        ids, starts, counts = np.unique(
            self.landmarks[order], return_index=True, return_counts=True
        )
        sums = np.add.reduceat(codes, starts, axis=0)
        landmark = np.repeat(np.arange(len(ids)), counts)
        chosen = counts[landmark] >= 3
        landmark, code = landmark[chosen], codes[chosen]
        others = (sums[landmark] - code) / (counts[landmark] - 1)[:, None]
        variance = (sums / counts[:, None]).var(axis=0).sum()
        return float(np.square(code - others).sum(axis=1).mean() / variance)


def read(tracks: Tracks, encoder: pm.Encoder, dim: int, first_id: int) -> CodedSequence:
    """Splits and encodes one file; its landmark ids start at `first_id`."""
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


def concatenated(sequences: list[CodedSequence]) -> CodedSequence:
    """The sequences as one."""
    return CodedSequence(
        np.concatenate([s.landmarks for s in sequences]),
        np.concatenate([s.codes for s in sequences]),
        np.concatenate([s.seen for s in sequences]),
        np.concatenate([s.frames for s in sequences]),
    )


def recall(
    scene: pm.PrototypeMap, queries: NDArray[np.int8], stated: float | None, nprobe: int | None
) -> float:
    """Share of the queries whose nearest landmark the search finds."""
    exact = scene.search_codes(queries, k=1)[1]
    found = scene.search_codes(queries, k=1, recall=stated, nprobe=nprobe)[1]
    return float(np.mean(found <= exact))


def least_nprobe(scene: pm.PrototypeMap, queries: NDArray[np.int8], wanted: float) -> int:
    """The smallest number of inverted lists that reaches a true recall."""
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
    frames = concatenated(sequences).frames
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
    other; the queries change in the same proportion.
    """
    old, new = concatenated(sequences[0::2]), concatenated(sequences[1::2])
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
    """Measures, prints the tables and draws the plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--dim", type=int, default=32, help="code length; default: 32")
    parser.add_argument("--plot", type=Path, help="SVG file to write")
    args = parser.parse_args()
    encoder = pm.Encoder.load(Tracks.load(args.tracks[0]).descriptor)
    parts = {
        file.name.split(".")[0]: read(Tracks.load(file), encoder, args.dim, i << 32)
        for i, file in enumerate(args.tracks)
    }
    rows, curves = [], []
    for name, s in {**parts, "all": concatenated(list(parts.values()))}.items():
        scene = pm.PrototypeMap(encoder, args.dim)
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
        "ten parts of the tracks": rounds(encoder, args.dim, sequences),
        "other sequences take over": drift(encoder, args.dim, sequences),
    }
    rows = [
        [name, *(f"{true:.3f} ({landmarks:,})" for landmarks, true in found)]
        for name, found in steps.items()
    ]
    numbers = [str(i + 1) for i in range(ROUNDS)]
    print(ReportTable(["recall (landmarks) after round", *numbers], rows).markdown())
    if args.plot:
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
        plot.save_svg(figure, args.plot, "benchmarks/scripts/index_recall.py")


if __name__ == "__main__":
    main()
