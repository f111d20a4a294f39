"""Writes what a map leaves for others: a map file, a COLMAP model, a trajectory, a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import replacing_folder, write_text
from protomark.geometry.colmap import pycolmap, quiet
from protomark.geometry.pose_files import tum_trajectory
from protomark.mapping.mapper import Mapper
from protomark.mapping.structure import Structure
from protomark.mapping.summary import map_pictures, summarise
from protomark.maps.open import SCENE_MAP
from protomark.report import map_page

MODEL, TRAJECTORY, REPORT, FIGURES = "sparse", "trajectory.txt", "report.html", "report.json"


def write_outputs(mapper: Mapper, scene: Path, source: str, finished: bool) -> dict[str, Any]:
    """Write all outputs of a map; returns its figures.

    Args:
        mapper: the map.
        scene: folder to write to.
        source: name of the input.
        finished: whether all frames of the input were added.
    """
    structure = mapper.structure
    figures = {"input": source, "finished": finished, **summarise(mapper)}
    ids = mapper.scene.ids
    mapper.scene.set_positions(ids, structure.positions[ids])
    mapper.scene.save(scene / SCENE_MAP)
    write_model(structure, scene / MODEL)
    frames = sorted(structure.frames, key=lambda f: (f.time, f.name))
    times = np.array([frame.time for frame in frames])
    poses = np.array([frame.pose for frame in frames]).reshape(-1, 3, 4)
    write_text(scene / TRAJECTORY, tum_trajectory(times, poses))
    page = map_page(figures, map_pictures(mapper, figures), f"Map of {source}")
    write_text(scene / REPORT, page)
    history = [vars(record) for record in mapper.history.records.values()]
    write_text(scene / FIGURES, json.dumps({**figures, "history": history}, indent=1) + "\n")
    return figures


def write_model(structure: Structure, folder: Path) -> None:
    """Write a COLMAP sparse model (binary) whose 3D point ids are the landmark ids."""
    reconstruction = pycolmap.Reconstruction()
    for camera_id in sorted({frame.camera_id for frame in structure.frames}):
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera({**structure.cameras[camera_id].as_dict(), "camera_id": camera_id})
        )
    tracks: dict[int, list[tuple[int, int]]] = {}
    for image_id, frame in enumerate(structure.frames, 1):
        rows = frame.observed
        image = pycolmap.Image(
            name=frame.name,
            camera_id=frame.camera_id,
            image_id=image_id,
            keypoints=frame.keypoints[rows].astype(np.float64).reshape(-1, 2),
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(frame.pose))
        for index, landmark in enumerate(frame.landmarks[rows].tolist()):
            tracks.setdefault(landmark, []).append((image_id, index))
    for landmark in sorted(tracks):
        track = pycolmap.Track([pycolmap.TrackElement(i, k) for i, k in tracks[landmark]])
        reconstruction.add_point3D_with_id(
            landmark, pycolmap.Point3D(xyz=structure.positions[landmark], track=track)
        )
        for image_id, index in tracks[landmark]:
            reconstruction.images[image_id].set_point3D_for_point2D(index, landmark)
    with quiet(), replacing_folder(folder) as temporary:
        reconstruction.update_point_3d_errors()
        reconstruction.write(str(temporary))
