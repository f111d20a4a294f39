"""Figures of an evaluation, and their JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import write_text

FORMAT = "protomark-evaluation"
VERSION = 1


@dataclass
class MethodResult:
    """Figures of one method on one sequence, one entry a seed where there are several.

    Attributes:
        name, label, family: as in `methods.MethodChoice`.
        bytes_per_landmark: all that matching needs, the count included, the position not.
        precision: share of queries whose nearest landmark is their own.
        search_ms: milliseconds to search for 1,000 queries on one thread.
        build_s: seconds to build the map.
        frames: query keyframes that were localized.
        found: those whose pose is within 1 % of the median scene depth and 2 degrees.
        accepted: matches that were given to RANSAC, over all frames.
        right: those of them that are right.
    """

    name: str
    label: str
    family: str
    bytes_per_landmark: list[float] = field(default_factory=list)
    precision: list[float] = field(default_factory=list)
    search_ms: list[float] = field(default_factory=list)
    build_s: list[float] = field(default_factory=list)
    frames: int = 0
    found: int = 0
    accepted: int = 0
    right: int = 0

    def summary(self) -> Summary:
        """Means over seeds; of the search times the least."""
        spread = float(np.std(self.precision, ddof=1)) if len(self.precision) > 1 else None
        return Summary(
            name=self.name,
            label=self.label,
            family=self.family,
            bytes_per_landmark=float(np.mean(self.bytes_per_landmark)),
            precision=float(np.mean(self.precision)),
            spread=spread,
            ratio=None,
            pose_recall=self.found / self.frames if self.frames else None,
            right_share=self.right / self.accepted if self.accepted else None,
            # Other work on the machine only ever adds.
            search_ms=min(self.search_ms),
        )


@dataclass
class Summary:
    """One row of a table.

    Attributes:
        spread: standard deviation of the precision over seeds (or None with one seed).
        ratio: precision as a share of the unaggregated one (or None where that was left out).
        pose_recall: share of query keyframes whose pose was found (or None without frames).
        right_share: share of right matches among those given to RANSAC (or None).
    """

    name: str
    label: str
    family: str
    bytes_per_landmark: float
    precision: float
    spread: float | None
    ratio: float | None
    pose_recall: float | None
    right_share: float | None
    search_ms: float


@dataclass
class SequenceResult:
    """All methods on one sequence.

    Attributes:
        sequence: its name.
        descriptor: name of the descriptor.
        keyframes, landmarks, observations: of the tracks.
        map_landmarks, support_observations, queries: means over seeds.
        scene_depth: median depth of the observations, in world units.
        seeds: seeds of the splits.
        methods: one result a method, in the order of the table.
        discriminant: what the linear discriminants were learned from.
    """

    sequence: str
    descriptor: str
    keyframes: int
    landmarks: int
    observations: int
    map_landmarks: float
    support_observations: float
    queries: float
    scene_depth: float
    seeds: list[int]
    discriminant: str
    methods: list[MethodResult]

    def rows(self) -> list[Summary]:
        """The rows of the table, with the ratio to the unaggregated map."""
        rows = [method.summary() for method in self.methods]
        whole = next((row.precision for row in rows if row.name == "unaggregated"), None)
        for row in rows:
            row.ratio = row.precision / whole if whole else None
        return rows


def mean_rows(results: Sequence[SequenceResult]) -> list[Summary]:
    """Means over sequences, of the methods that all of them have, in the first one's order."""
    tables = [{row.name: row for row in result.rows()} for result in results]
    rows = []
    for name, first in tables[0].items():
        if not all(name in table for table in tables):
            continue
        same = [table[name] for table in tables]
        means = {
            key: _mean([getattr(row, key) for row in same])
            for key in ("ratio", "pose_recall", "right_share")
        }
        rows.append(
            Summary(
                name=name,
                label=first.label,
                family=first.family,
                bytes_per_landmark=float(np.mean([row.bytes_per_landmark for row in same])),
                precision=float(np.mean([row.precision for row in same])),
                spread=None,
                search_ms=float(np.mean([row.search_ms for row in same])),
                **means,
            )
        )
    return rows


def save_json(results: Sequence[SequenceResult], path: str | os.PathLike[str]) -> None:
    """Write results and the rows that tables show, whole or not at all."""
    sequences = [
        {**asdict(result), "table": [asdict(row) for row in result.rows()]} for result in results
    ]
    document = {"format": FORMAT, "version": VERSION, "sequences": sequences}
    write_text(path, json.dumps(document, indent=1) + "\n")


def load_json(path: str | os.PathLike[str]) -> list[SequenceResult]:
    """Read what `save_json` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not such a file.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"{path}: not results of `protomark evaluate --json`")
        return [_sequence(entry) for entry in document["sequences"]]
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such results file") from None
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: broken results file ({error!r})") from None


def _sequence(entry: dict[str, Any]) -> SequenceResult:
    known = {f.name for f in fields(SequenceResult)} - {"methods"}
    methods = [MethodResult(**method) for method in entry["methods"]]
    return SequenceResult(**{key: entry[key] for key in known}, methods=methods)


def _mean(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if len(present) == len(values) else None
