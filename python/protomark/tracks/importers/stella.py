"""Reads maps of stella_vslam and OpenVSLAM, `.msg` (MessagePack) and `.db` (SQLite).

What their files hold was read in stella_vslam (BSD-2), data/ and camera/ at 76242fd, and checked on
files of it. Keypoints are stored undistorted, with (0, 0) as the centre of the first pixel.
"""

from __future__ import annotations

import re
import struct
from array import array
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import hash_files
from protomark.geometry.camera import Camera
from protomark.geometry.pose import rotation_from_quaternion
from protomark.tracks.file import Tracks
from protomark.tracks.importers.keyframes import (
    Keyframe,
    checked_features,
    distort,
    join,
    orb_sizes,
    unexpected,
)
from protomark.tracks.importers.messagepack import Unpacker
from protomark.tracks.sqlite import MAGIC, has_tables, open_database

PROGRAM = "stella_vslam"

_TABLES = ("cameras", "keyframes", "landmarks", "associations")
_KEYS = (*_TABLES[:3], "keyframe_next_id", "frame_next_id", "landmark_next_id", "orb_params")
_RECORDS = ("keypts", "undist_keypts", "undists", "descs", "x_rights", "depths")
_SETTINGS = {
    **{"num_levels": "levels", "scale_factor": "scale_factor"},
    **{"ini_fast_threshold": "fast_threshold", "min_fast_threshold": "min_fast_threshold"},
}
# A .db does not hold the settings; this is the default of ORB-SLAM and its descendants.
_SCALE_FACTOR = 1.2
# A cv::KeyPoint.
_NUMBERS = ("size", "angle", "response")
_KEYPOINT = np.dtype(
    [("xy", "<f4", 2), *((n, "<f4") for n in _NUMBERS), ("octave", "<i4"), ("class", "<i4")]
)

# Landmarks as nearly all are, which are read in one step.
_INT = rb"(?:[\0-\x7f]|\xcc.|\xcd..|\xce.{4})"
_USUAL_LANDMARK = re.compile(
    rb"\x85\xaa1st_keyfrm%b\xa5n_fnd%b\xa5n_vis%b\xa5pos_w\x93((?:\xcb.{8}){3})\xaaref_keyfrm%b"
    % (_INT, _INT, _INT, _INT),
    re.DOTALL,
)
_POSITION = struct.Struct(">xdxdxd")


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a file that begins with `head` is a map of stella_vslam."""
    if head[:1] and (head[0] & 0xF0 == 0x80 or head[0] in (0xDE, 0xDF)):
        size = {0xDE: 3, 0xDF: 5}.get(head[0], 1)
        return any(head.startswith(bytes([0xA0 + len(key)]) + key.encode(), size) for key in _KEYS)
    return has_tables(path, head, _TABLES)


def read(path: Path) -> Tracks:
    """Read a map.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the map is empty, or the file is broken.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such map of {PROGRAM}")
    source = {"program": PROGRAM, "digest": hash_files([("map", path)])}
    with path.open("rb") as file:
        is_database = file.read(len(MAGIC)) == MAGIC
    return (_read_database if is_database else _read_messagepack)(path).tracks(path, source)


@dataclass
class _Map:
    """What a file holds, in its own words."""

    version: str = "unknown"
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    keyframes: dict[int, dict[str, Any]] = field(default_factory=dict)
    landmark_ids: array[int] = field(default_factory=lambda: array("q"))
    positions: array[float] = field(default_factory=lambda: array("d"))

    def tracks(self, path: Path, source: dict[str, Any]) -> Tracks:
        detector: dict[str, Any] = {"name": "ORB-SLAM"}
        for values in list(self.settings.values())[:1]:
            for theirs, ours in _SETTINGS.items():
                if isinstance(values.get(theirs), (int, float)):
                    detector[ours] = values[theirs]
        if not self.keyframes:
            raise ValueError(
                f"{path}: this map of {PROGRAM} is empty: save it after the program has tracked "
                "images"
            )
        cameras = {}
        for number, (name, values) in enumerate(self.cameras.items(), 1):
            with unexpected(path, f"camera {name}"):
                cameras[name] = (number, _camera(values))
        keyframes = []
        for number in sorted(self.keyframes):
            with unexpected(path, f"keyframe {number}"):
                keyframes.append(self._keyframe(number, cameras))
        landmarks = np.array(self.landmark_ids), np.array(self.positions)
        if landmarks[0].size and landmarks[0].min() < 0:
            raise ValueError(f"{path}: a landmark has a negative id: a broken map")
        info = {"source": {**source, "version": self.version}, "detector": detector}
        return join(path, "orb", dict(cameras.values()), keyframes, landmarks, info)

    def _keyframe(self, number: int, cameras: dict[str, tuple[int, Camera]]) -> Keyframe:
        k = self.keyframes.pop(number)
        if k["cam"] not in cameras:
            raise ValueError(f"its camera {str(k['cam'])[:40]!r} is missing")
        (camera_id, camera), lens = cameras[k["cam"]], self.cameras[k["cam"]]
        xy = k["xy"].astype(np.float64)
        # stella_vslam has no half pixel in spherical images: its directions are what is kept.
        if camera.model != "EQUIRECTANGULAR":
            xy += 0.5
            if camera.model != "PINHOLE" and k["undistorted"]:
                center = lens["cx"] + 0.5, lens["cy"] + 0.5
                xy = distort(camera, xy, (lens["fx"], lens["fy"]), center)
        settings = self.settings.get(k.get("orb_params", ""), k)
        sizes = orb_sizes(k["octave"], float(settings.get("scale_factor", _SCALE_FACTOR)))
        if "size" in k:
            sizes = np.where(k["size"] > 0, k["size"], sizes)
        descriptors = k["descs"]
        features = checked_features(
            xy, descriptors, sizes, k["angle"], k.get("response"), k["octave"]
        )
        landmarks = np.asarray(k["lm_ids"], np.int64)
        if landmarks.shape != (len(features),):
            raise ValueError(f"{len(features)} keypoints have {landmarks.size} landmark ids")
        return Keyframe(f"keyframe{number}", camera_id, k["pose"], features, landmarks)


def _camera(c: dict[str, Any]) -> Camera:
    model, size = c["model_type"], (c["cols"], c["rows"])
    if model == "Equirectangular":
        camera = Camera("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])))
        camera.check()
        return camera
    if model not in ("Perspective", "Fisheye", "RadialDivision"):
        raise ValueError(f"the model {str(model)[:40]!r} is none of {PROGRAM}'s")
    pinhole = [c[name] for name in ("fx", "fy", "cx", "cy")]
    names = ("k1", "k2", "k3", "k4") if model == "Fisheye" else ("k1", "k2", "p1", "p2", "k3")
    lens = [c.get(name) or 0.0 for name in names]
    if model == "RadialDivision":
        camera = Camera.from_opencv(*size, pinhole)
        camera = replace(camera, model="DIVISION", params=(*camera.params, float(c["distortion"])))
        camera.check()
        return camera
    return Camera.from_opencv(*size, pinhole, lens, model == "Fisheye")


def _pose(rotation: NDArray[np.float64], translation: Any) -> NDArray[np.float64]:
    return np.column_stack([rotation, np.asarray(translation, np.float64).reshape(3)])


def _read_messagepack(path: Path) -> _Map:
    data = Unpacker(path.read_bytes(), path)
    found = _Map()
    versions: set[str] = set()
    for key in data.map_keys():
        if key in ("cameras", "orb_params"):
            values = data.value()
            if not isinstance(values, dict) or not all(
                isinstance(v, dict) for v in values.values()
            ):
                data.fail(f"{key} do not name maps of values")
            setattr(found, "cameras" if key == "cameras" else "settings", values)
        elif key == "keyframes":
            for name in data.map_keys():
                with unexpected(path, f"keyframe {name}"):
                    found.keyframes[int(name)] = _read_keyframe(data, versions)
        elif key == "landmarks":
            for name in data.map_keys():
                usual = data.match(_USUAL_LANDMARK)
                values = {} if usual else data.value()
                with unexpected(path, f"landmark {name}"):
                    x, y, z = _POSITION.unpack(usual[1]) if usual else values["pos_w"]
                    found.landmark_ids.append(int(name))
                    found.positions.extend((x, y, z))
        else:
            data.value()
    found.version = versions.pop() if len(versions) == 1 else "unknown"
    return found


def _read_keyframe(data: Unpacker, versions: set[str]) -> dict[str, Any]:
    k: dict[str, Any] = {}
    for key in data.map_keys():
        if key not in _RECORDS:
            k[key] = data.value()
            continue
        names, rows = data.table()
        if key == "descs":
            if names and names != [(i,) for i in range(8)]:
                raise ValueError("descriptors are not 8 numbers each")
            k["descs"] = rows.reshape(-1, 8).astype("<u4").view(np.uint8)
        # Until 0.3.3 a map also held the keypoints as the image has them.
        elif key == "keypts" or (key == "undist_keypts" and "xy" not in k):
            columns = dict(zip(names, rows.T.astype(np.float32), strict=True)) or {
                leaf: np.zeros(0, np.float32) for leaf in (("pt", 0), ("pt", 1), ("ang",), ("oct",))
            }
            k["xy"] = np.column_stack([columns["pt", 0], columns["pt", 1]])
            k["angle"], k["octave"] = columns["ang",], columns["oct",]
            k["undistorted"] = key == "undist_keypts"
    x, y, z, w = k["rot_cw"]
    k["pose"] = _pose(rotation_from_quaternion(np.array([w, x, y, z], float)), k["trans_cw"])
    if "n_scale_levels" in k:
        versions.add("before 0.3.0")
    elif not k["undistorted"]:
        versions.add("0.3.0 to 0.3.2")
    else:
        versions.add("0.3.3 to 0.3.7" if "src_frm_id" in k else "0.3.8 or later")
    return k


def _read_database(path: Path) -> _Map:
    found = _Map()
    with open_database(path, f"a map of {PROGRAM}") as database:
        columns = [c for c in database.columns("cameras") if c not in ("id", "name")]
        for _, (name, *values) in database.rows_by_id("cameras", ", ".join(["name", *columns])):
            camera = dict(zip(columns, values, strict=True))
            with unexpected(path, f"camera {str(name)[:40]!r}"):
                camera["model_type"] = _text(camera.get("model_type"))
                found.cameras[_text(name)] = camera
        kept = "cam, pose_cw, undist_keypts, descs"
        for number, (cam, pose, keypoints, descriptors) in database.rows_by_id("keyframes", kept):
            with unexpected(path, f"keyframe {number}"):
                points = np.frombuffer(keypoints or b"", _KEYPOINT)
                found.keyframes[number] = {
                    **{name: points[name] for name in ("xy", *_NUMBERS, "octave")},
                    "undistorted": True,
                    "cam": _text(cam),
                    "descs": np.frombuffer(descriptors or b"", np.uint8).reshape(-1, 32),
                    # Eigen's matrices are stored column by column.
                    "pose": np.frombuffer(pose, "<f8").reshape(4, 4).T[:3].copy(),
                }
        for number, (ids,) in database.rows_by_id("associations", "lm_ids"):
            with unexpected(path, f"keyframe {number}"):
                if number in found.keyframes:
                    found.keyframes[number]["lm_ids"] = np.frombuffer(ids or b"", "<i4")
        for number, (position,) in database.rows_by_id("landmarks", "pos_w"):
            with unexpected(path, f"landmark {number}"):
                x, y, z = np.frombuffer(position, "<f8")
                found.landmark_ids.append(number)
                found.positions.extend((x, y, z))
    return found


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
