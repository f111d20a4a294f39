"""The second half of a sequence localized in a map of its first half, by several kinds of map.

python benchmarks/localization_halves.py TRACKS --calibrate TRACKS... [--json FILE]

All descriptors of each landmark searched by Hamming distance, one medoid descriptor a landmark, and
prototypes go through the same code. What each accepts is fitted to the sequences of --calibrate.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import protomark as pm
from protomark.console import track
from protomark.localization.halves import (
    calibrated,
    localize_halves,
    medoids,
    prototypes,
    traditional,
)
from protomark.localization.results import THRESHOLDS
from protomark.tracks.file import Tracks, sequence_name


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tracks", type=Path)
    parser.add_argument("--calibrate", type=Path, nargs="+", required=True)
    parser.add_argument("--encoder", help="by default the one of the tracks' descriptor")
    parser.add_argument("--dims", default="16,32,64")
    parser.add_argument("--stride", type=int, default=1, help="every so many frames")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    tracks = Tracks.load(asked.tracks)
    others = [Tracks.load(path) for path in asked.calibrate]
    encoder = pm.Encoder.load(asked.encoder or tracks.descriptor)
    variants = [traditional(), medoids()]
    variants += [prototypes(encoder, int(dim)) for dim in asked.dims.split(",")]
    rows = []
    for variant in track(variants, "kinds of map"):
        acceptance = calibrated(variant, others)
        result, _ = localize_halves(tracks, variant, acceptance, stride=asked.stride)
        rows.append(result)
        shares = ", ".join(
            f"{r:.3f} at {d:g}/{a:g}" for r, (d, a) in zip(result.recall, THRESHOLDS, strict=True)
        )
        print(
            f"{result.variant:16} {result.bytes_per_landmark:7.1f} B  {shares}; median error "
            f"{result.median_error[0]:.4f}, {result.median_error[1]:.3f} degrees; "
            f"{result.median_inliers:.0f} inliers; search {result.search_ms:.1f} ms, "
            f"pose {result.pose_ms:.1f} ms"
        )
    if asked.json:
        facts = {
            "sequence": sequence_name(asked.tracks),
            "calibrated_on": [sequence_name(path) for path in asked.calibrate],
            "thresholds": THRESHOLDS,
            "rows": [row.as_dict() for row in rows],
        }
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
