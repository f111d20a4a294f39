"""A map in the making as a COLMAP reconstruction: to adjust it, and to write it as a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import replacing_folder
from protomark.geometry.colmap import add_points, new_reconstruction, quiet
from protomark.mapping.structure import Observations, Structure


def to_reconstruction(structure: Structure, frames: Sequence[int], seen: Observations) -> Any:
    """A `pycolmap.Reconstruction` of frames and their observations.

    Image ids are frame indices plus one, and point ids are landmark ids.
    """
    cameras = {
        i: structure.cameras[i] for i in sorted({structure.frames[i].camera_id for i in frames})
    }
    index = np.empty(len(seen.frames), np.int64)
    images = []
    for i in frames:
        frame, rows = structure.frames[i], np.flatnonzero(seen.frames == i)
        index[rows] = np.arange(len(rows))
        keypoints = frame.keypoints[seen.rows[rows]]
        images.append((i + 1, frame.name, frame.camera_id, keypoints, frame.pose))
    reconstruction = new_reconstruction(cameras, images)
    positions = structure.positions[np.unique(seen.landmarks)]
    add_points(reconstruction, seen.frames + 1, index, seen.landmarks, positions)
    return reconstruction


def write_model(structure: Structure, folder: Path) -> None:
    """Write a COLMAP sparse model (binary) whose 3D point ids are the landmark ids."""
    frames = range(len(structure.frames))
    reconstruction = to_reconstruction(structure, frames, structure.observations(frames))
    with quiet(), replacing_folder(folder) as temporary:
        reconstruction.update_point_3d_errors()
        reconstruction.write(str(temporary))
