"""Makes tracks of images that are described as RTAB-Map does by default: upright ORB of corners.

python benchmarks/scripts/gftt_tracks.py OUTPUT SEQUENCE... [--augmentations N]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from protomark.tracks import augmentation, extract

# RTAB-Map's settings, as its importer names them.
DETECTOR = {"name": "GFTT/ORB", "levels": 3, "scale_factor": 2.0}


def main() -> None:
    """Make the files NAME.orb.safetensors and NAME.orb.augmented.safetensors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--augmentations", type=int, default=0)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for folder in arguments.sequences:
        sequence = extract.find_sequence(folder)
        tracks = extract.extract(sequence, extract.TracksOptions("orb", detector=DETECTOR))
        tracks.save(arguments.output / f"{sequence.name}.orb.safetensors")
        print(
            f"{sequence.name}: {len(tracks.keypoints):,} keypoints, {len(tracks.landmark_ids):,} "
            f"landmarks, {len(tracks.observations):,} observations"
        )
        if count := arguments.augmentations:
            tracks = augmentation.add_augmentations(tracks, sequence.images, count)
            tracks.save(arguments.output / f"{sequence.name}.orb.augmented.safetensors")


if __name__ == "__main__":
    main()
