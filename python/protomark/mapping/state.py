"""Saves the state of a map in the making, so that mapping resumes exactly where it stopped.

A checkpoint holds the descriptors of the window; a finished map has none. Both hold the codes of
observations, by which `seal` tunes prototypes.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark._core import FileError
from protomark.extras import optional
from protomark.files import SCENE_MAP, STATE, replacing, replacing_folder
from protomark.geometry.camera import cameras_from_json
from protomark.mapping.frame import Frame
from protomark.mapping.history import History
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Prototypes
from protomark.mapping.options import MappingOptions
from protomark.mapping.self_calibration import Calibration
from protomark.mapping.structure import PER_LANDMARK, Structure
from protomark.maps.open import open_learning_map

CHECKPOINT = "checkpoint"
_FORMAT, _VERSION = "protomark-mapping", "1"


def save_checkpoint(mapper: Mapper, scene: Path, facts: dict[str, Any]) -> None:
    """Save everything that is needed to continue after the last frame, as the only checkpoint."""
    with replacing_folder(scene / CHECKPOINT) as folder:
        save_state(mapper, folder / STATE, facts)
        mapper.scene.save(folder / SCENE_MAP)


def save_state(mapper: Mapper, path: Path, facts: dict[str, Any]) -> None:
    """Write everything except the map file, and facts (JSON values) for `load_state`."""
    save = optional("safetensors.numpy").save
    structure, waiting = mapper.structure, mapper.initialiser.waiting
    frames = structure.frames
    every = [*frames, *waiting]
    descriptors = [f.descriptors for f in every if f.descriptors is not None]
    no_descriptors = np.zeros((0, mapper.descriptor_bytes), np.uint8)
    codes = [f.encoded for f in frames if not f.in_window and f.encoded is not None]
    arrays: dict[str, NDArray[Any]] = {
        **{name: getattr(structure, name) for name in PER_LANDMARK},
        "poses": np.array([f.pose for f in frames]).reshape(-1, 3, 4),
        "offsets": np.cumsum([0, *(len(f.keypoints) for f in every)]),
        "keypoints": np.concatenate([np.zeros((0, 2), np.float32), *(f.keypoints for f in every)]),
        "sigma": np.concatenate([np.zeros(0), *(f.sigma for f in every)]),
        "landmarks": np.concatenate([np.zeros(0, np.int64), *(f.landmarks for f in frames)]),
        "descriptors": np.concatenate([no_descriptors, *descriptors]),
        "codes": np.concatenate([mapper.memory.encode(no_descriptors), *codes]),
    }
    state = {
        "options": asdict(mapper.options),
        "cameras": {str(k): c.as_dict() for k, c in structure.cameras.items()},
        "camera_id": mapper.camera_id,
        "frames": [[f.index, f.name, f.time, f.camera_id, f.keyframe, f.in_window] for f in frames],
        "waiting": [[f.index, f.name, f.time, f.camera_id] for f in waiting],
        "best_parallax": mapper.initialiser.best_parallax,
        "next_global": mapper.next_global,
        "lost_in_row": mapper.lost_in_row,
        "calibration": asdict(mapper.calibration) if mapper.calibration else None,
        "history": mapper.history.as_dict(),
        "facts": facts,
    }
    metadata = {"format": _FORMAT, "version": _VERSION, "state": json.dumps(state)}
    with replacing(path) as file:
        file.write(save({k: np.ascontiguousarray(v) for k, v in arrays.items()}, metadata))


def load_state(folder: Path, threads: int = 1) -> tuple[Mapper, dict[str, Any]]:
    """Load a map or a checkpoint, to continue it, and the facts that were saved with it.

    Raises:
        FileNotFoundError: the folder is none of `protomark map`.
        FileError: its state is broken.
    """
    path = folder / STATE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no map: name a folder that `protomark map` wrote")
    try:
        arrays, state = _read(path)
        options = MappingOptions(**state["options"])
        cameras = cameras_from_json(state["cameras"])
        mapper = Mapper(options, cameras[state["camera_id"]], threads)
        assert isinstance(mapper.memory, Prototypes)
        mapper.memory.use(open_learning_map(folder / SCENE_MAP))
        mapper.structure.cameras = cameras
        mapper.camera_id = state["camera_id"]
        _restore_structure(mapper, arrays, state)
        _restore_frames(mapper, arrays, state)
        mapper.initialiser.best_parallax = state["best_parallax"]
        mapper.next_global, mapper.lost_in_row = state["next_global"], state["lost_in_row"]
        if mapper.calibration is not None:
            mapper.calibration = Calibration(**state["calibration"])
        mapper.history = History.from_dict(state["history"])
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError) as error:
        raise FileError(
            f"{path}: not the state of a map, or broken ({error}): make the map anew with --force"
        ) from None
    return mapper, state["facts"]


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    safetensors = optional("safetensors")
    try:
        with safetensors.safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise ValueError(str(error)) from None
    if metadata.get("format") != _FORMAT or metadata.get("version") != _VERSION:
        raise ValueError("its format or version is unknown")
    state: dict[str, Any] = json.loads(metadata["state"])
    return arrays, state


def _restore_structure(
    mapper: Mapper, arrays: dict[str, NDArray[Any]], state: dict[str, Any]
) -> None:
    count = len(arrays["positions"])
    empty = Structure()
    shapes = {name: (count, *getattr(empty, name).shape[1:]) for name in PER_LANDMARK}
    shapes["poses"] = (len(state["frames"]), 3, 4)
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, expected {shape}")
    if not count:
        raise ValueError("positions are missing")
    types = {"born": "int64", "views": "int64", "offsets": "int64", "landmarks": "int64"}
    types |= {"keypoints": "float32", "descriptors": "uint8", "codes": "int8"}
    for name in {*shapes, *types, "sigma"}:
        if arrays[name].dtype != types.get(name, "float64"):
            raise ValueError(f"{name} has the wrong type {arrays[name].dtype}")
    for name in PER_LANDMARK:
        setattr(mapper.structure, name, arrays[name])
    if not mapper.memory.contains(mapper.structure.ids).all():
        raise ValueError("its landmarks are not those of the map beside it")


def _restore_frames(mapper: Mapper, arrays: dict[str, NDArray[Any]], state: dict[str, Any]) -> None:
    structure = mapper.structure
    offsets, keypoints = arrays["offsets"], arrays["keypoints"]
    if arrays["sigma"].shape != (len(keypoints),):
        raise ValueError("there are not as many deviations as keypoints")
    count = len(state["frames"]) + len(state["waiting"])
    if len(offsets) != count + 1 or (np.diff(offsets) < 0).any() or offsets[-1] > len(keypoints):
        raise ValueError("its frames do not fit together")
    landmarks = arrays["landmarks"]
    if len(landmarks) and not -1 <= landmarks.min() <= landmarks.max() < len(structure.positions):
        raise ValueError("a keypoint observes a landmark that does not exist")
    codes = arrays["codes"]
    used = without = 0
    for i, (index, name, time, camera_id, *flags) in enumerate(state["frames"] + state["waiting"]):
        a, b = int(offsets[i]), int(offsets[i + 1])
        rays, turns = structure.cameras[camera_id].local_rays(keypoints[a:b])
        sigma = arrays["sigma"][a:b].copy()
        frame = Frame(index, name, time, camera_id, keypoints[a:b].copy(), rays, sigma, turns=turns)
        keyframe, in_window = flags or (True, True)
        if in_window:
            used += b - a
            if used > len(arrays["descriptors"]):
                raise ValueError("descriptors are missing")
            frame.descriptors = arrays["descriptors"][used - (b - a) : used].copy()
            frame.encoded = mapper.memory.encode(frame.descriptors)
        else:
            without += b - a
            frame.encoded = codes[without - (b - a) : without].copy()
            if frame.encoded.shape != (b - a, mapper.scene.dim):
                raise ValueError("codes are missing")
        if flags:
            frame.pose, frame.keyframe = arrays["poses"][i].copy(), keyframe
            frame.landmarks = landmarks[a:b].copy()
            structure.frames.append(frame)
        else:
            mapper.initialiser.waiting.append(frame)
