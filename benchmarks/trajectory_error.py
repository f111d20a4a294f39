"""Hold maps against true poses: python benchmarks/trajectory_error.py SCENE MODEL [SCENE MODEL]...

SCENE is what `protomark map` wrote, MODEL the COLMAP model with the true poses of its images.
Prints a row of docs/mapping.md for each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from protomark.evaluation.trajectory import trajectory_error
from protomark.localization.absolute_pose import centre
from protomark.tracks.colmap import find_model, model_of, read_model, read_reconstruction


def row(scene: Path, model: Path) -> str:
    """Frames registered, trajectory error, and the map's own figures."""
    found = model_of(read_reconstruction(scene / "sparse"), scene)
    true = read_model(find_model(model))
    poses = dict(zip(true.names, true.cam_from_world, strict=True))
    common = [i for i, name in enumerate(found.names) if name in poses]
    wanted = centre(np.array([poses[found.names[i]] for i in common]))
    error = trajectory_error(found.centers[common], wanted)
    length = np.linalg.norm(np.diff(true.centers, axis=0), axis=1).sum()
    facts = json.loads((scene / "report.json").read_text())
    return (
        f"| {model.resolve().name} | {facts['descriptor']} | {facts['memory']} "
        f"| {facts['registered']} of {facts['frames']} | {error.rmse:.3f} | {error.median:.3f} "
        f"| {length:.1f} | {facts['landmarks']:,} | {facts['track_length_mean']:.1f} "
        f"| {facts['reprojection_error_mean']:.2f} | {facts['memory_bytes'] / 1e6:.2f} "
        f"| {facts['descriptor_bytes'] / 1e6:.2f} |"
    )


if __name__ == "__main__":
    paths = [Path(argument) for argument in sys.argv[1:]]
    for pair in zip(paths[::2], paths[1::2], strict=True):
        print(row(*pair))
