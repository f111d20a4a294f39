"""Reads data sets of OpenSfM: reconstruction.json, tracks.csv and features/.

Their conventions were read in OpenSfM (BSD-2), features.py, io.py and actions/export_colmap.py:
poses are an axis-angle and a translation from the world to the camera; lengths in the image are in
units of its longer side, from its middle. Checked on a data set of it.
"""

from __future__ import annotations

import json
import re
import zipfile
from array import array
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Features
from protomark.files import hash_files, natural_key
from protomark.geometry.camera import Camera
from protomark.geometry.pose import rotation_from_quaternion
from protomark.tracks.file import Tracks
from protomark.tracks.importers.binary_descriptors import binary_descriptor, refusal
from protomark.tracks.importers.keyframes import Keyframe, checked_features, join, unexpected

PROGRAM = "OpenSfM"

_FILE = "reconstruction.json"
_CAMERAS = re.compile(rb'\s*\[.*"cameras"\s*:\s*\{', re.DOTALL)
_MAX_DEFLATION = 1100  # zlib makes data at most this many times smaller


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a folder, or a reconstruction.json in it, is a data set of OpenSfM."""
    if path.is_dir():
        return (path / _FILE).is_file()
    return path.suffix == ".json" and _CAMERAS.match(head) is not None


def read(path: Path) -> Tracks:
    """Read a data set, all reconstructions of it.

    A landmark's id is that of its track; in further reconstructions that are not connected with the
    first one, more than any before.

    Raises:
        FileNotFoundError: there is no such data set.
        ValueError: its descriptors are not binary, or it is broken.
    """
    file = path / _FILE if path.is_dir() else path
    folder = file.parent
    if not file.is_file():
        raise FileNotFoundError(f"{path}: no {_FILE} of {PROGRAM}")
    with unexpected(file, "reconstruction"):
        reconstructions = json.loads(file.read_bytes())
        shots = {name for r in reconstructions for name in r["shots"]}
    tracks_file = folder / "tracks.csv"
    if not tracks_file.is_file():
        raise FileNotFoundError(f"{tracks_file} is missing: it says which feature sees which point")
    with unexpected(tracks_file, "tracks"):
        names, seen = _observations(tracks_file, shots)
    read_files = [file, tracks_file]
    kinds: Counter[str] = Counter()
    dropped: Counter[str] = Counter()
    cameras: dict[Camera, int] = {}
    keyframes: list[Keyframe] = []
    ids, positions, maps = array("q"), array("d"), []
    for number, reconstruction in enumerate(reconstructions):
        shift = max(ids, default=-1) + 1 if number else 0
        known = _points(file, reconstruction, names, shift, ids, positions)
        first, by_name = len(keyframes), {}
        for name, values in reconstruction["cameras"].items():
            with unexpected(file, f"camera {name}"):
                by_name[name] = _camera(values)
        for name in sorted(reconstruction["shots"], key=natural_key):
            features_file = _features_file(folder, name)
            if features_file is None:
                dropped["keyframes without features"] += 1
                continue
            read_files.append(features_file)
            with unexpected(file, f"shot {name}"):
                shot = reconstruction["shots"][name]
                camera = by_name[shot["camera"]]
                pose = _pose(shot)
            with unexpected(features_file, "features"):
                kind, features = _features(features_file, camera)
                kinds[kind] += 1
                rows, tracks = seen.get(name, (array("q"), array("q")))
                label = np.full(len(features), -1, np.int64)
                label[np.array(rows, np.int64)] = known[np.array(tracks, np.int64)]
            camera_id = cameras.setdefault(camera, len(cameras) + 1)
            keyframes.append(Keyframe(name, camera_id, pose, features, label))
        maps.append(
            {
                "id": number,
                "keyframes": len(keyframes) - first,
                "landmarks": int((known >= 0).sum()),
            }
        )
    refused = [kind for kind in kinds if not kind.islower()]
    if refused or len(kinds) != 1:
        raise refusal(path, PROGRAM, refused)
    source: dict[str, Any] = {"program": PROGRAM, "version": "unknown", "maps": maps}
    source |= {"digest": hash_files((str(f.relative_to(folder)), f) for f in read_files)}
    source |= {"dropped": dict(dropped)}
    (kind,) = kinds
    info = {"source": source, "detector": {"name": kind.upper()}}
    by_number = {number: camera for camera, number in cameras.items()}
    return join(path, kind, by_number, keyframes, (np.array(ids), np.array(positions)), info)


def _observations(
    path: Path, shots: set[str]
) -> tuple[dict[str, int], dict[str, tuple[array[int], array[int]]]]:
    """Numbers of tracks by id, and rows of features with their tracks' numbers by image."""
    names: dict[str, int] = {}
    seen: dict[str, tuple[array[int], array[int]]] = {}
    with path.open(encoding="utf-8") as file:
        for line in file:
            if line.startswith("OPENSFM_TRACKS_VERSION") or not line.strip():
                continue
            image, track, feature, *_ = line.rstrip("\n").split("\t")
            if image in shots:
                rows, tracks = seen.setdefault(image, (array("q"), array("q")))
                rows.append(int(feature) if int(feature) >= 0 else 2**62)
                tracks.append(names.setdefault(track, len(names)))
    return names, seen


def _points(
    file: Path,
    reconstruction: dict[str, Any],
    names: dict[str, int],
    shift: int,
    ids: array[int],
    positions: array[float],
) -> NDArray[np.int64]:
    """Landmark ids by number of the track, -1 where the reconstruction has no point of it."""
    known = np.full(len(names), -1, np.int64)
    with unexpected(file, "points"):
        points = reconstruction["points"]
        whole = all(name.isdecimal() for name in names)
        for name, values in points.items():
            if name not in names:
                continue
            landmark = (int(name) if whole else names[name]) + shift
            known[names[name]] = landmark
            x, y, z = values["coordinates"]
            ids.append(landmark)
            positions.extend((x, y, z))
    return known


def _camera(c: dict[str, Any]) -> Camera:
    width, height = c["width"], c["height"]
    kind, unit = c.get("projection_type", "perspective"), max(width, height)
    if kind in ("spherical", "equirectangular"):
        camera = Camera("EQUIRECTANGULAR", width, height, (float(width), float(height)))
        camera.check()
        return camera
    k1, k2, k3, k4, p1, p2, x, y = (
        float(c.get(name) or 0) for name in ("k1", "k2", "k3", "k4", "p1", "p2", "c_x", "c_y")
    )
    focal = c["focal"] if "focal" in c else c["focal_x"]
    f = [unit * float(focal), unit * float(c.get("focal_y", focal))]
    middle = [width / 2 + unit * x, height / 2 + unit * y]
    model, params = {
        "perspective": ("RADIAL", [f[0], *middle, k1, k2]),
        "fisheye": ("RADIAL_FISHEYE", [f[0], *middle, k1, k2]),
        "simple_radial": ("OPENCV", [*f, *middle, k1, 0.0, 0.0, 0.0]),
        "radial": ("OPENCV", [*f, *middle, k1, k2, 0.0, 0.0]),
        "brown": ("FULL_OPENCV", [*f, *middle, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]),
        "fisheye_opencv": ("OPENCV_FISHEYE", [*f, *middle, k1, k2, k3, k4]),
    }.get(kind, (f"{kind!r} of {PROGRAM}", []))
    camera = Camera(model, width, height, tuple(params))
    camera.check()
    return camera


def _pose(shot: dict[str, Any]) -> NDArray[np.float64]:
    axis = np.array(shot["rotation"], np.float64).reshape(3)
    angle = float(np.linalg.norm(axis))
    quaternion = np.array([1.0, *axis / 2])
    if angle > 1e-8:
        quaternion = np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis / angle])
    rotation = rotation_from_quaternion(quaternion)
    return np.column_stack([rotation, np.array(shot["translation"], np.float64).reshape(3)])


def _features_file(folder: Path, image: str) -> Path | None:
    """The file of an image's features, by its names in all versions; None: there is none."""
    place = folder / "features"
    if ".." in Path(image).parts or Path(image).is_absolute():
        return None
    files = (
        place / f"{image}{suffix}" for suffix in (".features.npz", ".npz", ".orb.npz", ".akaze.npz")
    )
    return next((file for file in files if file.is_file()), None)


def _features(path: Path, camera: Camera) -> tuple[str, Features]:
    """Features of an image and their descriptor; if it is not binary, as it is called."""
    arrays = dict(_arrays(path, ("points", "descriptors")))
    points, descriptors = arrays["points"].astype(np.float64), arrays["descriptors"]
    if descriptors.ndim != 2 or points.ndim != 2 or points.shape[1] < 4:
        raise ValueError(f"points {points.shape} or descriptors {descriptors.shape} are no lists")
    size, kind = descriptors.shape[1], str(descriptors.dtype)
    unit = max(camera.width, camera.height)
    xy = points[:, :2] * unit + np.array([camera.width, camera.height]) / 2
    angles = points[:, 3]
    name = binary_descriptor("", kind, size)
    if name == "akaze" and (np.abs(angles) <= 2 * np.pi).all():
        angles = np.degrees(angles)  # those of the AKAZE in OpenSfM
    if name is None:
        return f"HAHOG or SIFT ({size} {kind})", checked_features(xy, descriptors, np.ones(len(xy)))
    return name, checked_features(xy, descriptors, points[:, 2] * unit, angles)


def _arrays(path: Path, names: tuple[str, ...]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays of an .npz file, of no more bytes than it can hold, without unpickling."""
    formats = np.lib.format
    with zipfile.ZipFile(BytesIO(path.read_bytes())) as archive:
        for name in names:
            entry = archive.getinfo(f"{name}.npy")
            if entry.file_size > _MAX_DEFLATION * path.stat().st_size:
                raise ValueError(f"{name} is larger than the file can hold")
            with archive.open(entry) as file:
                version = formats.read_magic(file)
                header = (
                    formats.read_array_header_1_0
                    if version == (1, 0)
                    else formats.read_array_header_2_0
                )
                shape, fortran, dtype = header(file)
                data = file.read()
            if (
                dtype.hasobject
                or fortran
                or dtype.itemsize * int(np.prod(shape, dtype=object)) != len(data)
            ):
                raise ValueError(f"{name} is no array of {len(data)} bytes")
            yield name, np.frombuffer(data, dtype).reshape(shape)
