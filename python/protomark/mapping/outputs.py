"""Writes the files of a map: the map itself, a COLMAP model, a trajectory and a report."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import SCENE_MAP, SEALED_MAP, replacing_folder, write_text
from protomark.geometry.pose_files import tum_trajectory
from protomark.mapping.mapper import Mapper
from protomark.mapping.reconstruction import write_model
from protomark.mapping.state import CHECKPOINT
from protomark.mapping.summary import map_pictures, summarise
from protomark.maps import cameras
from protomark.maps.seal import seal_map
from protomark.report import map_page

# The map before it was extended.
PREVIOUS = "previous"
MODEL, TRAJECTORY, REPORT, FIGURES = "sparse", "trajectory.txt", "report.html", "report.json"


def back_up(scene: Path) -> None:
    """Keep the files of a map that is about to be replaced in its folder `previous`.

    Of a map that a signal stopped, the folder holds what was there before it.
    """
    figures = scene / FIGURES
    if figures.is_file() and not json.loads(figures.read_text()).get("finished", True):
        return
    with replacing_folder(scene / PREVIOUS) as folder:
        link_files(scene, folder, PREVIOUS, CHECKPOINT, ".*")


def link_files(scene: Path, folder: Path, *left_out: str) -> None:
    """Fill a folder with links to a scene's files, which are replaced, never changed."""
    ignored = shutil.ignore_patterns(*left_out)
    shutil.copytree(
        scene, folder, symlinks=True, ignore=ignored, copy_function=_link, dirs_exist_ok=True
    )


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def write_outputs(
    mapper: Mapper, scene: Path, source: str, finished: bool, seal: bool = True
) -> dict[str, Any]:
    """Write all files of a map to the folder `scene`; returns its figures."""
    structure = mapper.structure
    figures = {"input": source, "finished": finished, **summarise(mapper, finished)}
    ids = mapper.scene.ids
    mapper.scene.set_positions(ids, structure.positions[ids])
    used = {structure.cameras[frame.camera_id] for frame in structure.frames}
    mapper.scene.metadata = {**mapper.scene.metadata, cameras.KEY: cameras.cameras_text(used)}
    (scene / SEALED_MAP).unlink(missing_ok=True)  # it would not be of this map
    mapper.scene.save(scene / SCENE_MAP)
    if seal and finished:
        sealed = seal_map(mapper.scene, scene / SEALED_MAP, observations=structure.codes())
        figures |= {"sealed_bytes": sealed["bytes"]}
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
