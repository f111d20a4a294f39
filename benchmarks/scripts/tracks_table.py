"""Writes docs/results/tracks.md: python benchmarks/scripts/tracks_table.py TRACKS..."""

from __future__ import annotations

import sys
from pathlib import Path

from protomark.files import write_text
from protomark.tracks import Tracks
from protomark.tracks.summary import summarise
from protomark_bench.report import ReportTable

PAGE = Path(__file__).parents[2] / "docs" / "results" / "tracks.md"
HEADS = (
    *("descriptor", "sequence", "poses", "keyframes", "keypoints", "landmarks", "observations"),
    *("mean length", "longest", "reprojection error, px (mean, median)"),
)


def table(paths: list[Path]) -> ReportTable:
    """A row per tracks file, by descriptor and name."""
    facts = [summarise(Tracks.load(path)) for path in paths]
    rows = [
        [
            row["descriptor"],
            row["sequence"],
            "refined" if row["poses_refined"] else "as given",
            f"{row['keyframes']}",
            f"{row['keypoints']:,}",
            f"{row['landmarks']:,}",
            f"{row['observations']:,}",
            f"{row['track_length_mean']:.2f}",
            f"{row['track_length_max']}",
            f"{row['reprojection_error_mean']:.2f}, {row['reprojection_error_median']:.2f}",
        ]
        for row in sorted(facts, key=lambda row: (row["descriptor"], row["sequence"]))
    ]
    return ReportTable(HEADS, rows, words=3)


if __name__ == "__main__":
    text = (
        "# Tracks of the ten sequences\n\nWritten by `benchmarks/scripts/tracks_table.py` from the "
        "tracks that the evaluation and the encoders use (see [tracks](../tracks.md)).\n\n"
    )
    write_text(PAGE, text + table([Path(p) for p in sys.argv[1:]]).markdown() + "\n")
