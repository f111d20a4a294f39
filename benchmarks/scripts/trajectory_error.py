"""Compares maps with true poses: python benchmarks/scripts/trajectory_error.py SCENE MODEL ...

SCENE is a folder that `protomark map` wrote, MODEL the COLMAP model with the true poses of its
images. Several pairs give several rows. Prints the errors of each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from protomark.geometry.colmap import (
    find_model,
    model_from_reconstruction,
    read_model,
    read_reconstruction,
)
from protomark_bench.report import ReportTable
from protomark_bench.trajectory import trajectory_error

HEADS = (
    *("sequence", "frames registered", "RMSE", "median", "path", "landmarks"),
    *("observations per landmark", "reprojection error, px", "prototypes, MB"),
    "all descriptors, MB",
)


def row(scene: Path, model: Path) -> list[str]:
    """Frames registered, trajectory error, and the map's own figures."""
    found = model_from_reconstruction(read_reconstruction(scene / "sparse"), scene)
    true = read_model(find_model(model))
    centers = dict(zip(true.names, true.centers, strict=True))
    common = [i for i, name in enumerate(found.names) if name in centers]
    wanted = np.array([centers[found.names[i]] for i in common])
    error = trajectory_error(found.centers[common], wanted)
    length = np.linalg.norm(np.diff(true.centers, axis=0), axis=1).sum()
    facts = json.loads((scene / "report.json").read_text())
    return [
        model.resolve().name,
        f"{facts['registered']} of {facts['frames']}",
        f"{error.rmse:.3f}",
        f"{error.median:.3f}",
        f"{length:.1f}",
        f"{facts['landmarks']:,}",
        f"{facts['track_length_mean']:.1f}",
        f"{facts['reprojection_error_mean']:.2f}",
        f"{facts['memory_bytes'] / 1e6:.2f}",
        f"{facts['descriptor_bytes'] / 1e6:.2f}",
    ]


if __name__ == "__main__":
    paths = [Path(argument) for argument in sys.argv[1:]]
    rows = [row(*pair) for pair in zip(paths[::2], paths[1::2], strict=True)]
    print(ReportTable(HEADS, rows).markdown())
