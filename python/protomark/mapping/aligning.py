"""Moves a scene into another world: its map, sealed map, model and trajectory together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.files import (
    SEALED_MAP,
    STATE,
    check_elsewhere,
    check_folder,
    only_writer,
    replacing_folder,
)
from protomark.geometry.camera import Camera
from protomark.geometry.control_points import (
    ControlPoints,
    read_control_points,
    triangulate_marks,
)
from protomark.geometry.pose import camera_centers, ground_plane
from protomark.geometry.pose_files import PoseSet, match_names, read_positions
from protomark.geometry.similarity import Array, Similarity, fit_robustly
from protomark.mapping.mapper import Mapper
from protomark.mapping.outputs import link_files, write_outputs
from protomark.mapping.state import CHECKPOINT, load_state, save_state
from protomark.maps.open import open_learning_map
from protomark.progress import Progress, silent
from protomark.threads import one_blas_thread

# Positions of other cameras fit worse than this share of their extent.
_MAX_RESIDUAL = 0.1


@dataclass(frozen=True)
class Target:
    """The world to move a scene into.

    Attributes:
        positions: file of camera positions or control points, or folder of a model; None: the scene
            is only scaled or turned.
        scale: factor for all lengths; None: that of the positions, else 1.
        up: whether to turn z up, as the images say.
        frame: the new world, for the map's metadata.
    """

    positions: Path | None = None
    scale: float | None = None
    up: bool = False
    frame: str | None = None

    def __post_init__(self) -> None:
        if self.positions is None and self.scale is None and not self.up:
            raise ValueError("name the world to move the scene into: --to, --scale or --up")
        if self.positions is not None and (self.scale is not None or self.up):
            raise ValueError("--to says how large the scene is and what is up: leave out the rest")
        if self.scale is not None and not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"--scale {self.scale:g} is not above 0")


def align_scene(path: Path, target: Target, progress: Progress = silent) -> dict[str, Any]:
    """Move the scene in a folder of `protomark map`, or a learning map, in place; returns facts.

    Either all of it is moved, or nothing is changed.

    Raises:
        FileNotFoundError, ValueError: there is no such scene, or nothing says where it belongs.
    """
    if path.is_dir():
        return _align_folder(path.resolve(), target, progress)
    if target.positions is not None or target.up:
        raise ValueError(
            f"{path} holds no cameras to align by: name the folder of `protomark map`, or --scale"
        )
    scene = open_learning_map(path)
    motion = Similarity(target.scale or 1.0, np.eye(3), np.zeros(3))
    scene.set_positions(scene.ids, motion(scene.positions(scene.ids)))
    dropped = _describe_frame(scene, target.frame)
    scene.save(path)
    return _facts(motion) | {"dropped_frame": dropped}


def _align_folder(folder: Path, target: Target, progress: Progress) -> dict[str, Any]:
    check_elsewhere(folder)
    check_folder(folder)
    check_folder(folder.parent)
    with only_writer(folder), one_blas_thread():
        if (folder / CHECKPOINT).is_dir():
            raise ValueError(f"{folder} holds an interrupted map: finish it with --resume first")
        if not (folder / STATE).is_file():
            raise ValueError(
                f"{folder} is no folder of a finished `protomark map`, whose files could be moved "
                f"together: name its map file to scale that"
            )
        mapper, facts = load_state(folder)
        motion, residuals = _motion(mapper, target)
        mapper.structure.move(motion)
        mapper.structure.recompute_views()
        frame = target.frame or residuals.get("frame") or None
        dropped = _describe_frame(mapper.scene, frame)
        mapper.history.events.append(
            f"aligned: scaled by {motion.scale:.6g}, turned by {motion.degrees:.1f} degrees"
        )
        progress("write", 0, 0)
        with _copy(folder) as copy:
            sealed = (copy / SEALED_MAP).is_file()
            before = pm.open(copy / SEALED_MAP) if sealed else None
            write_outputs(mapper, copy, folder.name, finished=True, seal=sealed)
            if before is not None:
                _check_sealed_alike(before, pm.open(copy / SEALED_MAP), folder)
            save_state(mapper, copy / STATE, facts)
    return _facts(motion) | residuals | {"dropped_frame": dropped}


@contextmanager
def _copy(folder: Path) -> Iterator[Path]:
    """A copy of a folder, which replaces it when the block ends without an error."""
    with replacing_folder(folder) as copy:
        link_files(folder, copy, ".lock*")
        yield copy


def _check_sealed_alike(before: Any, after: Any, folder: Path) -> None:
    names = ("words", "prototype_count", "bytes_per_landmark", "position_bits")
    if len(before) != len(after) or any(getattr(before, n) != getattr(after, n) for n in names):
        raise ValueError(
            f"{folder / SEALED_MAP} was sealed otherwise than by `protomark map`: remove it, align "
            "the scene and seal it again"
        )


def _describe_frame(scene: pm.PrototypeMap, frame: str | None) -> str | None:
    """Say which world the map is in now; returns what it said before and nothing replaces."""
    texts = dict(scene.metadata)
    old = texts.pop("frame", None)
    scene.metadata = texts if frame is None else {**texts, "frame": frame}
    return old if frame is None else None


def _motion(mapper: Mapper, target: Target) -> tuple[Similarity, dict[str, Any]]:
    file, frames = target.positions, mapper.structure.frames
    if file is not None:
        marks = read_control_points(file) if file.is_file() else None
        try:
            if marks is not None:
                motion, facts = _fit(*_measured(mapper, marks), "control points")
                return motion, facts | {"frame": marks.frame}
            given = read_positions(file)
            motion, facts = _fit(*_cameras(mapper, given), "cameras")
            return motion, facts | {"frame": given.frame}
        except ValueError as error:
            told = str(error)
            raise ValueError(told if str(file) in told else f"{file}: {told}") from None
    rotation = np.eye(3)
    if target.up:
        across, along = ground_plane(np.array([frame.pose for frame in frames]))
        rotation = np.stack([across, along, np.cross(across, along)])
    return Similarity(target.scale or 1.0, rotation, np.zeros(3)), {}


def _cameras(mapper: Mapper, given: PoseSet) -> tuple[list[str], Array, Array]:
    """Names (n,), positions (n, 3) and given positions (n, 3) of cameras."""
    frames = mapper.structure.frames
    named = match_names([frame.name for frame in frames], given.by_name)
    found = [(f, given.find(named.get(f.name, f.name), f.time)) for f in frames]
    pairs = [(frame, pose) for frame, pose in found if pose is not None]
    if len(pairs) < 3:
        raise ValueError(
            f"{len(pairs)} of {len(frames)} images of the scene have a position, such as "
            f"{given.example}, the scene {frames[0].name}: three are needed, under the same names"
        )
    at, to = (
        camera_centers(np.array(poses))
        for poses in ([frame.pose for frame, _ in pairs], [pose for _, pose in pairs])
    )
    return [frame.name for frame, _ in pairs], at, to


def _measured(mapper: Mapper, given: ControlPoints) -> tuple[list[str], Array, Array]:
    """Names (n,), positions (n, 3) and given positions (n, 3) of control points."""
    structure = mapper.structure
    frames = {frame.name: frame for frame in structure.frames}
    named = match_names(set(given.images), frames)

    def view(image: str) -> tuple[Camera, Array] | None:
        frame = frames[named[image]] if image in named else None
        return None if frame is None else (structure.cameras[frame.camera_id], frame.pose)

    at = triangulate_marks(given, view)
    seen = np.flatnonzero(np.isfinite(at[:, 0]))
    if len(seen) < 3:
        raise ValueError(
            f"{len(seen)} of {len(at)} control points are marked in two images of the scene that "
            f"see them from different sides: three are needed, in images such as "
            f"{structure.frames[0].name}"
        )
    return [given.names[i] for i in seen], at[seen], given.positions[seen]


def _fit(names: list[str], at: Array, to: Array, kind: str) -> tuple[Similarity, dict[str, Any]]:
    motion, inliers = fit_robustly(at, to)
    residuals = np.linalg.norm(motion(at) - to, axis=1)
    extent = float(np.linalg.norm(np.ptp(to, axis=0)))
    if np.median(residuals) > _MAX_RESIDUAL * extent:
        raise ValueError(
            f"the positions are {np.median(residuals):.3g} from those of the scene (median), which "
            f"is much of their extent of {extent:.3g}: are they those of these images?"
        )
    return motion, {
        "fitted": kind,
        "given": len(names),
        "inliers": int(inliers.sum()),
        "residual_median": float(np.median(residuals)),
        "residual_rmse_of_inliers": float(np.sqrt((residuals[inliers] ** 2).mean())),
        "residuals": dict(zip(names, residuals.tolist(), strict=True)),
    }


def _facts(motion: Similarity) -> dict[str, Any]:
    return {
        "scale": motion.scale,
        "rotation": motion.rotation.tolist(),
        "translation": motion.translation.tolist(),
        "degrees": motion.degrees,
    }
