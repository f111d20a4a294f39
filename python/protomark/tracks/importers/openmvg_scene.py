"""Reads OpenMVG's sfm_data, JSON and cereal's portable binary, of versions 0.1 to 0.3.

What it holds was read in OpenMVG (MPL-2), sfm/sfm_data_io_cereal.cpp and cameras/, and checked on a
file of it.
"""

from __future__ import annotations

import json
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.tracks.importers.binary import Reader
from protomark.tracks.importers.keyframes import unexpected, without_collector

VERSIONS = ("0.1", "0.2", "0.3")
# cereal writes ids of types and objects; those that it writes for the first time have this bit.
_NEW = 1 << 31
_SAME_TYPE = 1 << 30  # an object of the type of its pointer
_OBSERVATION = np.dtype([("view", "<u4"), ("feature", "<u4"), ("count", "<u8"), ("xy", "<f8", 2)])
# Names of distortion in JSON; in OpenCV's order, numbers are these of the file's.
_LENSES = {
    "pinhole": ("", ()),
    "pinhole_radial_k1": ("disto_k1", (0,)),
    "pinhole_radial_k3": ("disto_k3", (0, 1, None, None, 2)),
    "pinhole_brown_t2": ("disto_t2", (0, 1, 3, 4, 2)),
    "fisheye": ("fisheye", (0, 1, 2, 3)),
}


@dataclass
class Scene:
    """An sfm_data, in its own conventions but for cameras and poses, which are COLMAP's."""

    version: str
    views: dict[int, tuple[str, int, int]] = field(default_factory=dict)  # name, camera, pose
    cameras: dict[int, Camera] = field(default_factory=dict)
    poses: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    landmark_ids: array[int] = field(default_factory=lambda: array("q"))
    positions: array[float] = field(default_factory=lambda: array("d"))
    # Of each observation.
    landmarks: array[int] = field(default_factory=lambda: array("q"))
    view_ids: array[int] = field(default_factory=lambda: array("q"))
    features: array[int] = field(default_factory=lambda: array("q"))
    pixels: array[float] = field(default_factory=lambda: array("d"))

    def add_pose(self, number: int, rotation: Any, center: Any) -> None:
        """Add a pose of a rotation from the world to the camera, and the camera's centre."""
        r = np.array(rotation, np.float64).reshape(3, 3)
        self.poses[number] = np.column_stack([r, -r @ np.array(center, np.float64).reshape(3)])


def read_scene(path: Path) -> Scene:
    """Read an sfm_data, whose content says which kind it is.

    Raises:
        ValueError: it is broken.
    """
    data = path.read_bytes()
    with unexpected(path, "sfm_data"), without_collector():
        return _read_json(data) if data[:1] not in (b"\0", b"\1") else _read_binary(data, path)


def _camera(kind: str, width: int, height: int, focal: float, middle: Any, lens: Any) -> Camera:
    if kind not in _LENSES:
        raise ValueError(f"a camera of type {kind[:40]!r}, for which COLMAP has no model")
    x, y = middle
    order = _LENSES[kind][1]
    distortion = [0.0 if i is None else lens[i] for i in order]
    return Camera.from_opencv(width, height, (focal, focal, x, y), distortion, kind == "fisheye")


def _read_json(data: bytes) -> Scene:
    whole = json.loads(data)
    scene = Scene(str(whole["sfm_data_version"]))
    for view in whole["views"]:
        v = view["value"]["ptr_wrapper"]["data"]
        scene.views[view["key"]] = (v["filename"], v["id_intrinsic"], v["id_pose"])
    types: dict[int, str] = {}
    for intrinsic in whole["intrinsics"]:
        value = intrinsic["value"]
        number = value["polymorphic_id"]
        if number & _NEW:
            types[number & ~_NEW] = value["polymorphic_name"]
        c = value["ptr_wrapper"]["data"]
        c |= c.get("value0", {})
        kind = types[number & ~_NEW]
        lens = c.get(_LENSES.get(kind, ("",))[0], [])
        size = c["width"], c["height"]
        scene.cameras[intrinsic["key"]] = _camera(
            kind, *size, c.get("focal_length", 0.0), c.get("principal_point", (0, 0)), lens
        )
    for pose in whole["extrinsics"]:
        scene.add_pose(pose["key"], pose["value"]["rotation"], pose["value"]["center"])
    for landmark in whole["structure"]:
        x, y, z = landmark["value"]["X"]
        scene.landmark_ids.append(landmark["key"])
        scene.positions.extend((x, y, z))
        for observation in landmark["value"]["observations"]:
            u, v = observation["value"]["x"]
            scene.landmarks.append(landmark["key"])
            scene.view_ids.append(observation["key"])
            scene.features.append(observation["value"]["id_feat"])
            scene.pixels.extend((u, v))
    return scene


def _read_binary(data: bytes, path: Path) -> Scene:
    reader = Reader(data, path)
    if reader.u8() != 1:
        reader.fail("an sfm_data of a big-endian machine: export it as JSON")
    scene = Scene(_text(reader))
    if scene.version not in VERSIONS:
        reader.fail(f"version {scene.version[:20]!r} of sfm_data is none of {', '.join(VERSIONS)}")
    _text(reader)  # the folder of the images
    types: dict[int, str] = {}
    reader.where = "views"
    for _ in range(reader.count(40)):
        key = reader.u32()
        kind = _object(reader, types) if scene.version >= "0.3" else _new_object(reader)
        _text(reader)
        name = _text(reader)
        reader.array("<u4", 3)  # width, height, the view's id
        scene.views[key] = (name, reader.u32(), reader.u32())
        # Priors are only there if they are used, which nothing says.
        if kind == "view_priors" and reader.data[reader.offset :][:9] == b"\1\3" + bytes(7):
            reader.skip(1)
            _vector(reader, 3), _vector(reader, 3)
    reader.where = "intrinsics"
    for _ in range(reader.count(24)):
        key, kind = reader.u32(), _object(reader, types)
        width, height = reader.u32(), reader.u32()
        focal, middle = reader.f64(), _vector(reader, 2)
        lens = [] if kind == "pinhole" else _vector(reader, None)
        scene.cameras[key] = _camera(kind, width, height, focal, middle, lens)
    reader.where = "extrinsics"
    for _ in range(reader.count(140)):
        key = reader.u32()
        if reader.u64() != 3:
            reader.fail("a rotation should have 3 rows")
        scene.add_pose(key, [_vector(reader, 3) for _ in range(3)], _vector(reader, 3))
    reader.where = "structure"
    for _ in range(reader.count(44)):
        key = reader.u32()
        scene.landmark_ids.append(key)
        scene.positions.extend(_vector(reader, 3))
        seen = reader.array(_OBSERVATION, reader.count(_OBSERVATION.itemsize))
        if (seen["count"] != 2).any():
            reader.fail("an observation should have 2 coordinates")
        scene.landmarks.extend([key] * len(seen))
        scene.view_ids.extend(seen["view"].tolist())
        scene.features.extend(seen["feature"].tolist())
        scene.pixels.extend(seen["xy"].ravel().tolist())
    return scene


def _text(reader: Reader) -> str:
    return bytes(reader.take(reader.count(1))).decode()


def _vector(reader: Reader, size: int | None) -> list[float]:
    count = reader.count(8)
    if size is not None and count != size:
        reader.fail(f"{size} numbers should be here, not {count:,}")
    return [float(x) for x in reader.array("<f8", count)]


def _object(reader: Reader, types: dict[int, str]) -> str:
    """The type of the object that follows, "" for that of its pointer."""
    number, kind = reader.u32(), ""
    if number & _NEW:
        types[number & ~_NEW] = _text(reader)
    if number != _SAME_TYPE:
        kind = types[number & ~_NEW]
    return kind + _new_object(reader)


def _new_object(reader: Reader) -> str:
    if not reader.u32() & _NEW:
        reader.fail("an object that was written before is none of OpenMVG's")
    return ""
