"""How far observations are from their landmark's prototype, as a share of the prototypes' variance.

python benchmarks/observation_spread.py TRACKS... [--dim 32]

Each observation of a landmark with three or more is compared with the mean of the others.
core/src/probe_ranks.cpp moves its test queries by as much.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import protomark as pm
from protomark.tracks.file import Tracks
from protomark.training.sampling import Views


def main() -> None:
    """Print a line for each file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("tracks", nargs="+", type=Path)
    parser.add_argument("--dim", type=int, default=32)
    asked = parser.parse_args()
    for path in asked.tracks:
        tracks = Tracks.load(path)
        views = Views.from_tracks(tracks, path.stem)
        codes = pm.Encoder.load(tracks.descriptor).encode(views.descriptors, dim=asked.dim)
        codes = codes.astype(np.float64)
        counts = views.counts
        sums = np.add.reduceat(codes, views.starts[:-1], axis=0)
        landmark = np.repeat(np.arange(len(counts)), counts)
        enough = counts[landmark] >= 3
        own, code = landmark[enough], codes[enough]
        others = (sums[own] - code) / (counts[own] - 1)[:, None]
        squared = np.square(code - others).sum(axis=1)
        variance = (sums / counts[:, None]).var(axis=0).sum()
        print(f"{path.name}: mean {squared.mean() / variance:.2f}")


if __name__ == "__main__":
    main()
