"""Keyframes as importers read them, checked and joined to tracks."""

from __future__ import annotations

import gc
import struct
import tarfile
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protomark.features.extractor import FEATURE_ARRAYS, Features
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks

# What ORB-SLAM's extractor takes a keypoint's orientation from, in pixels of its pyramid level.
_ORB_PATCH = 31
_MAX_OCTAVE = 32
_UNEXPECTED = (
    *(IndexError, TypeError, ValueError, OverflowError, RecursionError, SyntaxError, EOFError),
    *(AttributeError, NotImplementedError, RuntimeError, struct.error, tarfile.TarError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
_MAX_PIXEL = 1e9


@contextmanager
def unexpected(path: Path, what: str) -> Iterator[None]:
    """Turn errors of unexpected values in the block into ValueErrors that say where they are."""
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused where it is used
            yield
    except KeyError as error:
        problem = f"it has no {str(error.args[0])[:40]}"
    except _UNEXPECTED as error:
        problem = str(error).splitlines()[0][:300] if str(error) else type(error).__name__
        if problem.startswith(str(path)):
            raise
    else:
        return
    raise ValueError(f"{path}, {what}: {problem}: save the map anew")


@contextmanager
def without_collector() -> Iterator[None]:
    """Do not look for garbage in the block: what is read has no cycles, and is looked at anew."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@dataclass
class Keyframe:
    """A keyframe of another program's map, in COLMAP's conventions (see `Tracks`)."""

    name: str
    camera_id: int
    cam_from_world: NDArray[np.float64]  # (3, 4)
    features: Features
    landmarks: NDArray[np.int64]  # (n,) id of each keypoint's landmark, negative for none


def join(
    path: Path,
    descriptor: str,
    cameras: Mapping[int, Camera],
    keyframes: list[Keyframe],
    landmarks: tuple[ArrayLike, ArrayLike],
    info: dict[str, Any],
) -> Tracks:
    """The tracks of keyframes, which are emptied to save memory.

    Observations of a landmark that is not there, and all but the first one that a keyframe has of
    a landmark, are keypoints of no landmark; `info["source"]["dropped"]` counts them.

    Args:
        path: the map, for errors.
        descriptor: name of the descriptor.
        cameras: cameras by id.
        keyframes: m keyframes.
        landmarks: ids (l,) and positions (l, 3).
        info: what the tracks say of themselves, with a "source".

    Raises:
        ValueError: something does not fit together.
    """
    if not any(len(k.features) for k in keyframes):
        raise ValueError(
            f"{path}: a map with {len(keyframes)} keyframes and no keypoint: give a map that was "
            "saved after its program had seen something"
        )
    ids = np.asarray(landmarks[0], np.int64).reshape(-1)
    positions = np.asarray(landmarks[1], np.float64).reshape(-1, 3)
    order = np.argsort(ids, kind="stable")
    ids, positions = ids[order], positions[order]
    dropped: Counter[str] = Counter(info["source"].get("dropped", {}))
    for keyframe in keyframes:
        check_pose(keyframe.cam_from_world, path, keyframe.name)
    observed = _observed(keyframes, ids, dropped)
    if dropped := +dropped:
        info["source"]["dropped"] = dict(dropped)
    arrays = {}
    features = [k.features for k in keyframes]
    for name in FEATURE_ARRAYS:
        arrays[name] = np.concatenate([getattr(f, name) for f in features])
        if name != "keypoints":
            for f in features:
                setattr(f, name, None)
    tracks = Tracks(
        descriptor=descriptor,
        cameras=dict(cameras),
        keyframe_names=[k.name for k in keyframes],
        keyframe_camera=np.array([k.camera_id for k in keyframes], np.int32),
        cam_from_world=np.array([k.cam_from_world for k in keyframes], np.float64),
        offsets=np.cumsum([0, *map(len, features)], dtype=np.int64),
        **arrays,
        landmark_of_keypoint=observed,
        landmark_ids=ids,
        landmark_positions=positions,
        info=info,
        input="bits",
    )
    try:
        tracks.check()
    except ValueError as error:
        raise ValueError(f"{path}: {str(error).removeprefix('tracks: ')}: a broken map") from None
    return tracks


def _observed(
    keyframes: list[Keyframe], ids: NDArray[np.int64], dropped: Counter[str]
) -> NDArray[np.int64]:
    """The landmark of each keypoint (n,), one of the ascending `ids` or -1; counts what is lost."""
    labels = np.concatenate([k.landmarks for k in keyframes])
    known = np.append(ids, -1)[np.searchsorted(ids, labels)] == labels
    dropped["observations of missing landmarks"] += int((~known & (labels >= 0)).sum())
    seen = np.flatnonzero(known & (labels >= 0))
    in_keyframe = np.repeat(np.arange(len(keyframes)), [len(k.landmarks) for k in keyframes])
    order = seen[np.lexsort((labels[seen], in_keyframe[seen]))]
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(labels[order]) != 0) | (np.diff(in_keyframe[order]) != 0)
    dropped["observations of a landmark twice in a keyframe"] += int((~first).sum())
    observed = np.full(len(labels), -1)
    observed[order[first]] = labels[order[first]]
    return observed


def check_pose(pose: NDArray[np.float64], path: Path, name: object) -> None:
    """Raise ValueError unless a pose (3, 4) is a rigid motion."""
    rotation = pose[:, :3]
    # False for NaN, and for infinite and huge numbers without a warning.
    rigid = np.abs(pose).max() < _MAX_PIXEL and np.abs(rotation).max() < 2
    if not (rigid and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3):
        raise ValueError(f"{path}: the pose of keyframe {name} is not a rigid motion: a broken map")
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"{path}: the pose of keyframe {name} is a reflection: a broken map")


def checked_features(
    xy: ArrayLike,
    descriptors: NDArray[np.uint8],
    sizes: ArrayLike,
    angles: ArrayLike | None = None,
    responses: ArrayLike | None = None,
    octaves: ArrayLike | None = None,
) -> Features:
    """Features of numbers that nobody has checked.

    Args:
        xy: (n, 2) pixels in COLMAP's convention.
        descriptors: (n, bytes) uint8.
        sizes: (n,) diameters in pixels.
        angles: (n,) degrees clockwise, -1 for none; None: none has one.
        responses: (n,) the detector's strength; None: 0.
        octaves: (n,) pyramid levels; None: 0.

    Raises:
        ValueError: a number is not finite, or beyond any image or pyramid.
    """
    n = len(descriptors)
    given = {"positions": xy, "sizes": sizes, "angles": angles, "responses": responses}
    values = {
        name: np.full(n, -1.0 if name == "angles" else 0.0) if v is None else np.asarray(v, float)
        for name, v in (*given.items(), ("octaves", octaves))
    }
    for name, numbers in values.items():
        if len(numbers) != n:
            raise ValueError(f"{n} keypoints have {len(numbers)} {name}")
        if not (np.abs(numbers) < (_MAX_OCTAVE if name == "octaves" else _MAX_PIXEL)).all():
            raise ValueError(f"{name} of keypoints are beyond any image")
    turns = np.where(values["angles"] == -1, -1, np.mod(values["angles"], 360)).astype(np.float32)
    turns[turns >= 360] = 0
    return Features(
        values["positions"].reshape(-1, 2).astype(np.float32),
        values["sizes"].astype(np.float32),
        turns,
        values["responses"].astype(np.float32),
        values["octaves"].astype(np.int32),
        descriptors,
    )


def orb_sizes(octaves: ArrayLike, scale_factor: float) -> NDArray[np.float64]:
    """Diameters (n,) in pixels of ORB-SLAM's keypoints at pyramid levels (n,).

    Raises:
        ValueError: the levels or the factor between them are of no pyramid.
    """
    levels = np.asarray(octaves, np.float64)
    if not (1 <= scale_factor <= 4 and (np.abs(levels) < _MAX_OCTAVE).all()):
        raise ValueError(f"octaves or their scale factor {scale_factor!r} are of no image pyramid")
    return np.asarray(_ORB_PATCH * np.power(scale_factor, levels))


def distort(
    camera: Camera, xy: NDArray[np.float64], focal: ArrayLike, center: ArrayLike
) -> NDArray[np.float64]:
    """Pixels (n, 2) of the camera's images, of pixels in images without distortion.

    Where the camera does not reach, the pixel stays.

    Args:
        camera: the camera with its distortion.
        xy: (n, 2) pixels of a pinhole camera of the same pose.
        focal: its focal lengths in pixels.
        center: its principal point in pixels.
    """
    rays = np.column_stack([(xy - np.asarray(center)) / np.asarray(focal), np.ones(len(xy))])
    with np.errstate(all="ignore"):
        found = camera.project(rays)
    beyond = np.abs(found).max(axis=1, initial=0.0) > 2 * max(camera.width, camera.height)
    return np.where((beyond | ~np.isfinite(found).all(axis=1))[:, None], xy, found)
