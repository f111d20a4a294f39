"""Write the table of docs/tracks.md: python benchmarks/tracks_table.py TRACKS..."""

from __future__ import annotations

import sys
from pathlib import Path

from documents import replace_tables
from protomark.tracks import Tracks
from protomark.tracks.summary import summarise

DOCUMENT = Path(__file__).parent.parent / "docs" / "tracks.md"


def table(paths: list[Path]) -> str:
    """A row a tracks file, by descriptor and name."""
    lines = [
        "| descriptor | sequence | keyframes | keypoints | landmarks | observations | mean length "
        "| longest | reprojection error, px (mean, median) | poses |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    facts = [summarise(Tracks.load(path)) for path in paths]
    for row in sorted(facts, key=lambda row: (row["descriptor"], row["sequence"])):
        lines.append(
            f"| {row['descriptor']} | {row['sequence']} | {row['keyframes']} "
            f"| {row['keypoints']:,} | {row['landmarks']:,} | {row['observations']:,} "
            f"| {row['track_length_mean']:.2f} | {row['track_length_max']} "
            f"| {row['reprojection_error_mean']:.2f}, {row['reprojection_error_median']:.2f} "
            f"| {'refined' if row['poses_refined'] else 'as given'} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    replace_tables(DOCUMENT, table([Path(p) for p in sys.argv[1:]]))
