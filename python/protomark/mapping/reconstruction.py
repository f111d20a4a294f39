"""Writes a map in the making as a COLMAP model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protomark.files import replacing_folder
from protomark.geometry.colmap import add_points, new_reconstruction, quiet
from protomark.mapping.structure import Structure


def write_model(structure: Structure, folder: Path) -> None:
    """Write a COLMAP sparse model (binary): image ids count from 1, point ids are landmark ids."""
    seen = structure.observations(range(len(structure.frames)))
    used = sorted({frame.camera_id for frame in structure.frames})
    index = np.empty(len(seen.frames), np.int64)
    images = []
    for i, frame in enumerate(structure.frames):
        rows = np.flatnonzero(seen.frames == i)
        index[rows] = np.arange(len(rows))
        images.append(
            (i + 1, frame.name, frame.camera_id, frame.keypoints[seen.rows[rows]], frame.pose)
        )
    reconstruction = new_reconstruction({i: structure.cameras[i] for i in used}, images)
    positions = structure.positions[np.unique(seen.landmarks)]
    add_points(reconstruction, seen.frames + 1, index, seen.landmarks, positions)
    with quiet(), replacing_folder(folder) as temporary:
        reconstruction.update_point_3d_errors()
        reconstruction.write(str(temporary))
