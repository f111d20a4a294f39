"""Prints bytes per landmark of learning maps, without positions and encoder.

python benchmarks/scripts/learning_map_bytes.py TRACKS...
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import protomark as pm
from protomark.maps.build import build_map
from protomark.tracks import Tracks


def bytes_per_landmark(tracks: Tracks) -> float:
    """Of a map with the defaults of `protomark build`."""
    scene = build_map(tracks, pm.Encoder.load(tracks.descriptor))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.pmk"
        scene.save(path)
        sizes = dict(pm.file_sections(path))
    return (sum(sizes.values()) - sizes["encoder"] - sizes["position"]) / len(scene)


if __name__ == "__main__":
    found = defaultdict(list)
    for name in sys.argv[1:]:
        tracks = Tracks.load(Path(name))
        found[tracks.descriptor].append(bytes_per_landmark(tracks))
        print(f"{name}: {found[tracks.descriptor][-1]:.1f}")
    for descriptor, values in found.items():
        print(f"{descriptor}: {np.mean(values):.0f}; {min(values):.0f} to {max(values):.0f}")
