"""Writes the files of a map: the map itself, a COLMAP model, a trajectory and a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import write_text
from protomark.geometry.pose_files import tum_trajectory
from protomark.mapping.mapper import Mapper
from protomark.mapping.reconstruction import write_model
from protomark.mapping.summary import map_pictures, summarise
from protomark.maps.open import SCENE_MAP
from protomark.report import map_page

MODEL, TRAJECTORY, REPORT, FIGURES = "sparse", "trajectory.txt", "report.html", "report.json"


def write_outputs(mapper: Mapper, scene: Path, source: str, finished: bool) -> dict[str, Any]:
    """Write all files of a map to the folder `scene`; returns its figures.

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
