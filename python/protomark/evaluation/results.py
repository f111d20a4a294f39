"""Results of an evaluation as JSON, tables and curves."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from protomark.evaluation.protocol import SplitKind
from protomark.files import write_text
from protomark.plot import AMBER, INK, MUTED, OURS, RED, Curve, draw_curves, new_figure, save_figure
from protomark.report import markdown_table, percent

FORMAT = "protomark-evaluation"
VERSION = 1

_TABLE_HEAD = (
    "method",
    "bytes per landmark",
    "precision",
    "of unaggregated",
    "poses found",
    "right matches",
    "ms per 1,000 queries",
)
# Families of several sizes have a colour, single methods are grey.
_COLOURS = {
    "pca": AMBER,
    "discriminant": "#7c3aed",
    "pq": RED,
    "itq": "#db2777",
    "lsh": INK,
}
_OUR_COLOURS = (OURS, "#0369a1", "#4d7c0f", "#be123c")
_CURVE_LABELS = {
    "unaggregated": "all descriptors",
    "random": "random",
    "first": "first seen",
    "majority": "quantised mean",
    "and": "bitwise AND",
    "medoid": "medoid",
    "clusters": "mean-shift clusters",
    "mean": "mean, float",
    "pca": "PCA",
    "discriminant": "discriminant",
    "pq": "product quantiser",
    "itq": "ITQ",
    "lsh": "LSH",
    "protomark": "Protomark",
    "protomark-sealed": "Protomark, sealed",
    "protomark-appearances": "sealed, tuned by appearances",
    "protomark-untuned": "sealed, untuned",
}


@dataclass
class MethodResult:
    """Results of one method on one sequence, with one entry per seed in the lists."""

    # name, label, family: see `methods.MethodChoice`.
    name: str
    label: str
    family: str
    # All that matching needs, including the count, without the position.
    bytes_per_landmark: list[float] = field(default_factory=list)
    # Share of queries whose nearest landmark is their own.
    precision: list[float] = field(default_factory=list)
    # Milliseconds to search for 1,000 queries on one thread.
    search_ms: list[float] = field(default_factory=list)
    build_s: list[float] = field(default_factory=list)  # seconds to build the map
    frames: int = 0  # query keyframes that were localized
    # Query keyframes whose pose is within 1 % of the median scene depth and 2 degrees.
    found: int = 0
    selected: int = 0  # matches for RANSAC, over all frames
    right: int = 0  # selected matches that are right
    # Landmarks that are rightly the nearest of a keypoint, selected or not, over all frames.
    landmarks_found: int = 0

    def summary(self) -> MethodSummary:
        """Means over seeds, but the least search time."""
        spread = float(np.std(self.precision, ddof=1)) if len(self.precision) > 1 else None
        return MethodSummary(
            name=self.name,
            label=self.label,
            family=self.family,
            bytes_per_landmark=float(np.mean(self.bytes_per_landmark)),
            precision=float(np.mean(self.precision)),
            spread=spread,
            pose_recall=self.found / self.frames if self.frames else None,
            right_share=self.right / self.selected if self.selected else None,
            landmarks_per_frame=self.landmarks_found / self.frames if self.frames else None,
            # Other programs on the machine only add time.
            search_ms=min(self.search_ms),
        )


@dataclass
class MethodSummary:
    """One row of a table."""

    # name, label, family: see `methods.MethodChoice`.
    name: str
    label: str
    family: str
    bytes_per_landmark: float  # see `MethodResult`
    precision: float  # mean precision
    # Standard deviation of the precision over seeds, None with one seed.
    spread: float | None = None
    ratio: float | None = None  # precision as a share of the unaggregated one, None without that
    # Share of query keyframes whose pose was found, None without frames.
    pose_recall: float | None = None
    # Share of right matches among the selected ones, None without matches.
    right_share: float | None = None
    landmarks_per_frame: float | None = None  # right landmarks per frame, None without frames
    search_ms: float = 0.0  # milliseconds to search for 1,000 queries on one thread


@dataclass
class SequenceResult:
    """All methods on one sequence."""

    sequence: str
    descriptor: str
    split: SplitKind  # how keyframes were split into map and queries
    # keyframes, landmarks, observations: numbers in the tracks.
    keyframes: int
    landmarks: int
    observations: int
    # map_landmarks, support_observations, queries: mean numbers over seeds.
    map_landmarks: float
    support_observations: float
    queries: float
    scene_depth: float  # median depth of the observations, in world units
    seeds: list[int]  # seeds of the splits
    discriminant: str  # what the linear discriminants were learned from
    methods: list[MethodResult]  # one result per method, in the order of the table

    def rows(self) -> list[MethodSummary]:
        """The rows of the table, with the ratio to the unaggregated map."""
        rows = [method.summary() for method in self.methods]
        whole = next((row.precision for row in rows if row.name == "unaggregated"), None)
        for row in rows:
            row.ratio = row.precision / whole if whole else None
        return rows


def mean_rows(results: Sequence[SequenceResult]) -> list[MethodSummary]:
    """Means over sequences of the methods that all of them have, in the order of the first."""
    tables = [{row.name: row for row in result.rows()} for result in results]
    rows = []
    for name, first in tables[0].items():
        if not all(name in table for table in tables):
            continue
        same = [table[name] for table in tables]
        means: dict[str, Any] = {
            key: _mean([getattr(row, key) for row in same])
            for key in (
                "bytes_per_landmark",
                "precision",
                "ratio",
                "pose_recall",
                "right_share",
                "landmarks_per_frame",
            )
        }
        search_ms = float(np.mean([row.search_ms for row in same]))
        rows.append(MethodSummary(name, first.label, first.family, **means, search_ms=search_ms))
    return rows


def save_json(results: Sequence[SequenceResult], path: str | os.PathLike[str]) -> None:
    """Write results and the rows of their tables atomically."""
    sequences = [
        {**asdict(result), "table": [asdict(row) for row in result.rows()]} for result in results
    ]
    document = {"format": FORMAT, "version": VERSION, "sequences": sequences}
    write_text(path, json.dumps(document, indent=1) + "\n")


def caption(result: SequenceResult) -> str:
    """The data of an evaluation in one line."""
    return (
        f"{result.sequence}, {result.descriptor.upper()}, {result.split} split: "
        f"{result.keyframes} keyframes, "
        f"{result.map_landmarks:,.0f} landmarks in the map from "
        f"{result.support_observations:,.0f} observations, {result.queries:,.0f} queries, "
        f"{len(result.seeds)} seed{'s' if len(result.seeds) != 1 else ''}"
    )


def table_row(row: MethodSummary) -> list[str]:
    """The cells of a table row as text."""
    spread = f" ±{row.spread:.3f}" if row.spread is not None else ""
    return [
        row.label,
        f"{row.bytes_per_landmark:,.0f}",
        f"{row.precision:.3f}{spread}",
        percent(row.ratio),
        percent(row.pose_recall),
        percent(row.right_share),
        f"{row.search_ms:,.0f}" if row.search_ms >= 10 else f"{row.search_ms:.1f}",
    ]


def group_by_descriptor(results: Sequence[SequenceResult]) -> dict[str, list[SequenceResult]]:
    """The results for each descriptor, in their order."""
    groups: dict[str, list[SequenceResult]] = {}
    for result in results:
        groups.setdefault(result.descriptor, []).append(result)
    return groups


def evaluation_markdown(results: Sequence[SequenceResult]) -> str:
    """All tables by descriptor, and their mean if there are several."""
    parts = []
    for descriptor, same in group_by_descriptor(results).items():
        if len(same) > 1:
            names = ", ".join(result.sequence for result in same)
            parts.append(f"#### {descriptor.upper()}, {same[0].split} split: mean of {names}\n")
            parts.append(summary_markdown(mean_rows(same)))
        for result in same:
            parts.append(f"#### {caption(result)}\n")
            parts.append(summary_markdown(result.rows()))
    return "\n".join(parts)


def summary_markdown(rows: Sequence[MethodSummary]) -> str:
    """A table in Markdown, in which Protomark's rows are bold."""
    ours = [row.family.startswith("protomark") for row in rows]
    return markdown_table(_TABLE_HEAD, [table_row(row) for row in rows], ours)


def precision_curves(rows: Sequence[MethodSummary]) -> list[Curve]:
    """Curves of precision over bytes per landmark, one per family of methods."""
    families: dict[str, list[MethodSummary]] = {}
    for row in rows:
        families.setdefault(row.family, []).append(row)
    our_families = [family for family in families if family.startswith("protomark")]
    curves = []
    for family, members in families.items():
        members = sorted(members, key=lambda row: row.bytes_per_landmark)
        ours = family in our_families
        kind, _, encoder = family.partition("@")
        colour = (
            _OUR_COLOURS[our_families.index(family) % len(_OUR_COLOURS)]
            if ours
            else _COLOURS.get(family.removesuffix("-float"), MUTED)
        )
        curves.append(
            Curve(
                f"{_CURVE_LABELS.get(kind, kind)} {encoder}".rstrip(),
                [row.bytes_per_landmark for row in members],
                [row.precision for row in members],
                [row.spread or 0.0 for row in members],
                colour,
                ours,
            )
        )
    return curves


def save_precision_plot(rows: Sequence[MethodSummary], path: Path, title: str = "") -> None:
    """Plot precision over bytes per landmark as PNG, SVG or PDF."""
    figure = new_figure(8, 5)
    axes = figure.add_subplot()
    draw_curves(axes, precision_curves(rows), "bytes per landmark (log)", "precision", title)
    save_figure(figure, path, made_by="protomark evaluate")


def _mean(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if len(present) == len(values) else None
