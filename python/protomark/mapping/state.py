"""A map in the making as files, so that it can be gone on with later: exactly where it stopped.

Descriptors of the window are in it while frames come in; a finished map has none.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.errors import FileError
from protomark.files import replacing
from protomark.mapping.history import History
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Prototypes
from protomark.mapping.outputs import MAP, replace_folder
from protomark.mapping.settings import Settings
from protomark.mapping.sighting import Sighting
from protomark.mapping.structure import Frame
from protomark.tracks.colmap import rays
from protomark.tracks.file import Camera, cameras_of

STATE, CHECKPOINT = "state.safetensors", "checkpoint"
_FORMAT, _VERSION = "protomark-mapping", "3"


def save_checkpoint(mapper: Mapper, scene: Path, facts: dict[str, Any]) -> None:
    """Save all that is needed to go on after the last frame; replaces the last checkpoint."""

    def write(folder: str) -> None:
        save_state(mapper, Path(folder) / STATE, facts)
        if isinstance(mapper.memory, Prototypes):
            mapper.memory.map.save(Path(folder) / MAP)

    replace_folder(scene / CHECKPOINT, write)


def save_state(mapper: Mapper, path: Path, facts: dict[str, Any]) -> None:
    """Write everything but the map file.

    Args:
        mapper: the map in the making, between two frames.
        path: file to write.
        facts: what the caller wants back from `load_state`, for JSON.
    """
    from safetensors.numpy import save

    structure, waiting = mapper.structure, mapper.initialiser.waiting
    frames = structure.frames
    every: list[Frame | Sighting] = [*frames, *waiting]
    kept = [f.descriptors for f in frames if f.descriptors is not None]
    kept += [s.descriptors for s in waiting]
    width = mapper.width
    arrays: dict[str, NDArray[Any]] = {
        "positions": structure.positions,
        "directions": structure.directions,
        "looks": structure.looks,
        "distances": structure.distances,
        "born": structure.born,
        "poses": np.array([f.pose for f in frames]).reshape(-1, 3, 4),
        "offsets": np.cumsum([0, *(len(f.keypoints) for f in every)]),
        "keypoints": np.concatenate([np.zeros((0, 2), np.float32), *(f.keypoints for f in every)]),
        "landmarks": np.concatenate([np.zeros(0, np.int64), *(f.landmarks for f in frames)]),
        "descriptors": np.concatenate([np.zeros((0, width), np.uint8), *kept]),
        **mapper.memory.arrays(),
    }
    told = {
        "settings": asdict(mapper.settings),
        "cameras": {str(k): c.as_dict() for k, c in structure.cameras.items()},
        "camera_id": mapper.camera_id,
        "frames": [
            [f.index, f.name, f.time, f.camera_id, f.keyframe, f.descriptors is not None]
            for f in frames
        ],
        "waiting": [[s.index, s.name, s.time, s.camera_id] for s in waiting],
        "best_parallax": mapper.initialiser.best_parallax,
        "next_global": mapper.next_global,
        "lost_in_row": mapper.lost_in_row,
        "guess": mapper.guess,
        "begun_again": mapper.begun_again,
        "history": mapper.history.as_dict(),
        "facts": facts,
    }
    metadata = {"format": _FORMAT, "version": _VERSION, "state": json.dumps(told)}
    with replacing(path) as file:
        file.write(save({k: np.ascontiguousarray(v) for k, v in arrays.items()}, metadata))


def load_state(
    folder: Path, threads: int = 1, camera: Camera | None = None
) -> tuple[Mapper, dict[str, Any]]:
    """Take up a map where it was saved.

    Args:
        folder: a scene, or a checkpoint.
        threads: threads to search and adjust on.
        camera: camera of the frames to come, if it is another one than before.

    Returns:
        The map in the making, and what the caller of `save_state` wanted back.

    Raises:
        FileError: there is none, or it is broken.
    """
    path = folder / STATE
    try:
        arrays, told = _read(path)
        settings = Settings(**told["settings"])
        cameras = cameras_of(told["cameras"])
        scene = None
        if settings.memory == "prototypes":
            opened = pm.open(folder / MAP)
            if not isinstance(opened, pm.PrototypeMap):
                raise ValueError(f"{folder / MAP} is sealed")
            scene = opened
        mapper = Mapper(settings, cameras[told["camera_id"]], threads)
        mapper.memory.restore(arrays, scene)
        mapper.structure.cameras = cameras
        mapper.camera_id = told["camera_id"]
        _restore(mapper, arrays, told)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError) as error:
        raise FileError(f"{path}: not a map to go on with, or a broken one ({error})") from None
    if camera is not None and camera != mapper.camera:
        mapper.camera_id = max(cameras) + 1
        mapper.structure.cameras[mapper.camera_id] = camera
    return mapper, told["facts"]


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileError(f"{path}: no such file; is this the folder of a map?")
    try:
        with safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(str(error)) from None
    if metadata.get("format") != _FORMAT or metadata.get("version") != _VERSION:
        raise ValueError("another format or version")
    told: dict[str, Any] = json.loads(metadata["state"])
    return arrays, told


def _restore(mapper: Mapper, arrays: dict[str, NDArray[Any]], told: dict[str, Any]) -> None:
    structure = mapper.structure
    many = len(arrays["positions"])
    shapes: dict[str, tuple[int, ...]] = {
        "positions": (many, 3),
        "directions": (many, 3),
        "looks": (many,),
        "distances": (many, 2),
    }
    shapes |= {"born": (many,), "poses": (len(told["frames"]), 3, 4)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, expected {shape}")
    if not many:
        raise ValueError("positions are missing")
    types = {"born": "int64", "looks": "int64", "offsets": "int64", "landmarks": "int64"}
    types |= {"keypoints": "float32", "descriptors": "uint8"}
    for name in {*shapes, *types}:
        if arrays[name].dtype != types.get(name, "float64"):
            raise ValueError(f"{name} is of type {arrays[name].dtype}")
    structure.positions, structure.directions = arrays["positions"], arrays["directions"]
    structure.looks = arrays["looks"]
    structure.distances, structure.born = arrays["distances"], arrays["born"]
    offsets, keypoints = arrays["offsets"], arrays["keypoints"]
    count = len(told["frames"]) + len(told["waiting"])
    if len(offsets) != count + 1 or (np.diff(offsets) < 0).any() or offsets[-1] > len(keypoints):
        raise ValueError("its frames do not fit together")
    landmarks = arrays["landmarks"]
    if len(landmarks) and not -1 <= landmarks.min() <= landmarks.max() < many:
        raise ValueError("a keypoint sees a landmark that is not there")
    kept = 0

    def descriptors(n: int) -> NDArray[np.uint8]:
        nonlocal kept
        kept += n
        if kept > len(arrays["descriptors"]):
            raise ValueError("descriptors are missing")
        return arrays["descriptors"][kept - n : kept].copy()

    for i, (index, name, time, camera_id, keyframe, whole) in enumerate(told["frames"]):
        a, b = int(offsets[i]), int(offsets[i + 1])
        mine = descriptors(b - a) if whole else None
        structure.frames.append(
            Frame(
                index=index,
                name=name,
                time=time,
                camera_id=camera_id,
                pose=arrays["poses"][i].copy(),
                keypoints=keypoints[a:b].copy(),
                landmarks=landmarks[a:b].copy(),
                rays=rays(structure.cameras[camera_id], keypoints[a:b]),
                keyframe=keyframe,
                descriptors=mine,
                encoded=None if mine is None else mapper.memory.encode(mine),
            )
        )
    for i, (index, name, time, camera_id) in enumerate(told["waiting"], len(told["frames"])):
        a, b = int(offsets[i]), int(offsets[i + 1])
        mine = descriptors(b - a)
        mapper.initialiser.waiting.append(
            Sighting(
                index,
                name,
                time,
                camera_id,
                keypoints[a:b].copy(),
                rays(structure.cameras[camera_id], keypoints[a:b]),
                mine,
                mapper.memory.encode(mine),
            )
        )
    if not mapper.memory.known(structure.ids).all():
        raise ValueError("its landmarks are not those of its map")
    mapper.initialiser.best_parallax = told["best_parallax"]
    mapper.next_global, mapper.lost_in_row = told["next_global"], told["lost_in_row"]
    mapper.guess, mapper.begun_again = float(told["guess"]), bool(told["begun_again"])
    mapper.history = History.from_dict(told["history"])
