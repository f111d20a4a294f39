"""Reads ORB-SLAM2's maps as osmap saves them: .yaml, .keyframes, .mappoints and .features."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import hash_files
from protomark.geometry.camera import Camera
from protomark.geometry.pose import camera_centers, transform
from protomark.tracks.file import Tracks
from protomark.tracks.importers.binary import Reader
from protomark.tracks.importers.protobuf import BYTES, FIXED32, FIXED64, VARINT, fields, varint

PROGRAM = "ORB-SLAM2 (osmap)"
_MARK = b"mappointsFile:"
_NUMBER = r"([-+.\deE]+)"
_CAMERA = re.compile(rf"fx:\s*{_NUMBER},\s*fy:\s*{_NUMBER},\s*cx:\s*{_NUMBER},\s*cy:\s*{_NUMBER}")
_NOT_DELIMITED = "FEATURES_FILE_NOT_DELIMITED"
# Pixels that an ORB descriptor describes, and the usual scale factor, which files lack.
_PATCH, _SCALE_FACTOR = 31.0, 1.2
_DESCRIPTOR, _MAX_OCTAVE, _MAX_PIXEL = 32, 32, 1e5
_SIZES = (_PATCH * _SCALE_FACTOR ** np.arange(_MAX_OCTAVE)).astype(np.float32)
_MAX_ID = 2**63 - 1
_MAX_SKEW = 0.01
_USUAL_SIZES = (
    *((320, 240), (640, 480), (752, 480), (848, 480)),
    *((640, 360), (1280, 720), (1280, 800), (1280, 960), (1280, 1024), (1920, 1080)),
)
_SIZE_TOLERANCE = 0.05
_BLOCK = 32  # landmarks that are projected at a time
_F32, _F64, _POSE, _BYTES = (struct.Struct(f"<{form}") for form in ("f", "d", "12f", "32s"))

# Landmarks and features as osmap writes nearly all, in one step: `_point` and `_feature` read any.
_ID, _FLOAT, _DESCRIPTOR_FIELD = rb"([\x80-\xff]{0,8}[\0-\x7f])", rb"(.{4})", rb"\"\n (.{32})"
_USUAL_POINT = re.compile(
    rb"\x08%b\x12\x0f\r%b\x15%b\x1d%b(?:[\x1d%%].{4}){0,2}\*%b"
    % (_ID, _FLOAT, _FLOAT, _FLOAT, _DESCRIPTOR_FIELD),
    re.DOTALL,
)
_USUAL_FEATURE = re.compile(
    rb"\n(.)\r%b\x15%b(?:\x18([\0-\x1f]))?(?:%%%b)?()(?:\x10%b)?\x1a%b"
    % (_FLOAT, _FLOAT, _FLOAT, _ID, _DESCRIPTOR_FIELD),
    re.DOTALL,
)

_KEYFRAMES = struct.Struct("<QQd12f")
_KEYFRAME = np.dtype([("id", "<u8"), ("camera", "<u8"), ("time", "<f8"), ("pose", "<f4", (3, 4))])
_POINTS = struct.Struct("<Q3f32s")
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f4", 3), ("descriptor", "u1", _DESCRIPTOR)])
_FEATURES = struct.Struct("<QQB3f32s")
_FEATURE = np.dtype(
    [
        *((name, "<u8") for name in ("keyframe", "point")),
        ("octave", "u1"),
        ("xy", "<f4", 2),
        ("angle", "<f4"),
        ("descriptor", "u1", _DESCRIPTOR),
    ]
)


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a file is the .yaml of a map, or a folder holds one."""
    return bool(_descriptions(path)) if path.is_dir() else _MARK in head


def _descriptions(folder: Path) -> list[Path]:
    found = []
    for path in sorted(folder.glob("*.yaml")):
        if path.is_file():
            with path.open("rb") as file:
                found += [path] if _MARK in file.read(4096) else []
    return found


def read(path: Path) -> Tracks:
    """Read a map by its .yaml or its folder.

    Without a .features file there is one descriptor per landmark, and nothing tells whose keypoint
    it was. It becomes one where the landmark projects to in the keyframe that faces it most
    directly, and `info["source"]["note"]` says so.

    Raises:
        FileNotFoundError: a file that the .yaml names is missing.
        ValueError: a file is broken, or the map is empty.
    """
    if path.is_dir():
        found = _descriptions(path)
        if len(found) != 1:
            raise ValueError(f"{path} holds {len(found)} maps of osmap: name the .yaml of one")
        path = found[0]
    text = path.read_text(errors="replace")
    files = {kind: _named(path, text, kind) for kind in ("keyframes", "mappoints", "features")}
    for kind in ("keyframes", "mappoints"):
        if not files[kind].is_file():
            raise FileNotFoundError(f"{files[kind]}: no such file, but {path.name} names it")
    keyframes, points = _keyframes(files["keyframes"]), _points(files["mappoints"])
    features = _features(files["features"], text) if files["features"].is_file() else None
    used = [path, *(file for file in files.values() if file.is_file())]
    try:
        tracks = _tracks(keyframes, points, features, text)
        tracks.check()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    tracks.info["source"]["digest"] = hash_files((file.name, file) for file in used)
    return tracks


def _named(path: Path, text: str, kind: str) -> Path:
    """The file of a kind, which lies beside the .yaml, wherever that was written."""
    match = re.search(rf'^{kind}File:\s*"?([^"\r\n]+)', text, re.MULTILINE)
    name = re.split(r"[/\\]", match[1].strip())[-1] if match else ""
    return path.parent / (name or f"{path.stem}.{kind}")


def _keyframes(path: Path) -> NDArray[Any]:
    reader, out = Reader(path.read_bytes(), path), bytearray()
    for size in _messages(reader):
        row: dict[str, Any] = {"id": 0, "camera": 0, "time": 0.0, "pose": ()}
        for number, wire, value in fields(reader, size):
            if (number, wire) == (1, VARINT):
                row["id"] = value
            elif (number, wire) == (2, BYTES):
                row["pose"] = _packed(reader, value, _POSE)
            elif wire == VARINT:
                row["camera"] = value
            elif wire == FIXED64:
                (row["time"],) = _F64.unpack(value)
        reader.expect(row["pose"], f"keyframe {row['id']} has no pose")
        pose = row.pop("pose")
        out += _KEYFRAMES.pack(*row.values(), *pose)
    return np.frombuffer(out, _KEYFRAME)


def _points(path: Path) -> NDArray[Any]:
    reader, out = Reader(path.read_bytes(), path), bytearray()
    for size in _messages(reader):
        begin = reader.offset
        if usual := _USUAL_POINT.fullmatch(reader.data, begin, begin + size):
            number, *values = usual.groups()
            out += b"".join((_id(number), *values))
        else:
            out += _point(reader, size)
    return np.frombuffer(out, _POINT)


def _id(varint: bytes | None) -> bytes:
    """Eight bytes of a number of up to 63 bits that is 7 bits in each byte; 0 without."""
    value = 0
    for shift, byte in enumerate(varint or b""):
        value |= (byte & 127) << 7 * shift
    return value.to_bytes(8, "little")


def _point(reader: Reader, size: int) -> bytes:
    point, descriptor, xyz = 0, b"", [0.0, 0.0, 0.0]
    for number, wire, value in fields(reader, size):
        if (number, wire) == (1, VARINT):
            point = value
        elif (number, wire) == (2, BYTES):
            xyz = _position(reader, value)
        elif (number, wire) == (5, BYTES):
            descriptor = b"".join(_packed(reader, value, _BYTES))
    reader.expect(descriptor, f"landmark {point} has no descriptor")
    return _POINTS.pack(point, *xyz, descriptor)


def _position(reader: Reader, size: int) -> list[float]:
    """x, y and z, of which zeros may be left out."""
    xyz = [0.0, 0.0, 0.0]
    for axis, wire, number in fields(reader, size):
        reader.expect(axis <= 3 and wire == FIXED32, "a position is not x, y, z")
        (xyz[axis - 1],) = _F32.unpack(number)
    return xyz


def _features(path: Path, text: str) -> NDArray[Any]:
    """Features of keyframes, in one message, or each keyframe's in one after its length."""
    reader, out = Reader(path.read_bytes(), path), bytearray()
    if _NOT_DELIMITED in text:
        for size in _messages(reader):
            _add_features(reader, size, out)
    else:
        while len(reader):
            size = varint(reader)
            reader.expect(size <= len(reader), f"{size:,} bytes of a keyframe should follow")
            end, first = reader.offset + size, reader.offset
            # Messages of keyframes may be wrapped in ones of lists.
            if size and reader.data[first] == (1 << 3 | BYTES):
                for _, _, inner in fields(reader, size):
                    _add_features(reader, inner, out)
            else:
                _add_features(reader, size, out)
            reader.expect(reader.offset == end, "a message ends elsewhere")
    return np.frombuffer(out, _FEATURE)


def _add_features(reader: Reader, size: int, out: bytearray) -> None:
    """Add the features of a keyframe; wire types tell most of their fields."""
    keyframe, rows = 0, bytearray()
    for _, wire, value in fields(reader, size):
        if wire == VARINT:
            keyframe = value
        elif wire == BYTES:
            begin = reader.offset
            usual = _USUAL_FEATURE.fullmatch(reader.data, begin, begin + value)
            if usual and usual[1][0] == usual.start(6) - begin - 2:
                _, x, y, octave, angle, _, point, descriptor = usual.groups()
                numbers = (octave or b"\0", x, y, angle or bytes(4), descriptor)
                rows += b"".join((bytes(8), _id(point), *numbers))
            else:
                rows += _feature(reader, value)
    added = np.frombuffer(rows, _FEATURE)
    added["keyframe"] = keyframe
    out += rows


def _feature(reader: Reader, size: int) -> bytes:
    point = octave = 0
    floats = [0.0, 0.0, 0.0]
    descriptor = b""
    for _, wire, value in fields(reader, size):
        if wire == VARINT:
            point = value
        elif wire == BYTES and value >= _DESCRIPTOR and reader.data[reader.offset] & 7 == BYTES:
            descriptor = b"".join(_packed(reader, value, _BYTES))
        elif wire == BYTES:
            for number, kind, inner in fields(reader, value):
                if kind == VARINT:
                    octave = inner
                elif kind == FIXED32:
                    (floats[min(number - 1, 2)],) = _F32.unpack(inner)
    reader.expect(descriptor and octave < _MAX_OCTAVE, "a keypoint has no descriptor or octave")
    return _FEATURES.pack(0, point, octave, *floats, descriptor)


def _messages(reader: Reader) -> Iterator[int]:
    """Sizes of the messages that a file lists."""
    for _, wire, size in fields(reader):
        reader.expect(wire == BYTES, "a number stands where a message should")
        yield size


def _packed(reader: Reader, size: int, form: struct.Struct) -> tuple[Any, ...]:
    """The numbers of a message of one list of numbers."""
    numbers: tuple[Any, ...] = ()
    for _, wire, length in fields(reader, size):
        reader.expect(wire == BYTES and length == form.size, f"{form.size} bytes should follow")
        numbers = reader.unpack(form)
    return numbers


def _tracks(
    keyframes: NDArray[Any], points: NDArray[Any], features: NDArray[Any] | None, text: str
) -> Tracks:
    if not len(keyframes) or not len(points):
        raise ValueError("the map is empty: it has no keyframes or no landmarks")
    for kind, table in (("keyframes", keyframes), ("landmarks", points)):
        if len(np.unique(table["id"])) < len(table) or table["id"].max() > _MAX_ID:
            raise ValueError(f"two {kind} have the same id, or one an id that is too large")
    keyframes, points = (_ascending(table) for table in (keyframes, points))
    poses = keyframes["pose"].astype(np.float64)
    turns = poses[:, :, :3]
    if not (np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)) < _MAX_SKEW).all():  # or NaN
        raise ValueError("a keyframe has a pose that is no rotation and translation")
    dropped: Counter[str] = Counter()
    numbers = keyframes["camera"] if len(_CAMERA.findall(text)) > 1 else 0 * keyframes["camera"]
    cameras = _cameras(text, features, numbers)
    source: dict[str, Any] = {"program": PROGRAM, "version": "unknown"}
    columns: Any = features
    if features is None:
        columns = _projected(keyframes, points, cameras, numbers, dropped)
        source["note"] = (
            "no .features: the one descriptor of each landmark has no keypoint of its own"
        )
    row = np.searchsorted(keyframes["id"], columns["keyframe"])
    row = np.minimum(row, len(keyframes) - 1)
    present = keyframes["id"][row] == columns["keyframe"]
    dropped["keypoints of keyframes that are not in the file"] = int((~present).sum())
    order = np.flatnonzero(present)[np.argsort(row[present], kind="stable")]
    row, seen, octaves = row[order], columns["point"][order], columns["octave"][order]
    ids = points["id"]
    known = ids[np.minimum(np.searchsorted(ids, seen), len(ids) - 1)] == seen
    dropped["observations of landmarks that are not in the file"] = int((~known & (seen > 0)).sum())
    angles = columns["angle"][order]
    angles = np.where(angles >= 0, angles % np.float32(360), np.float32(-1))
    return Tracks(
        descriptor="orb",
        cameras={number + 1: camera for number, camera in enumerate(cameras)},
        keyframe_names=[f"{k['time']:.6f} ({k['id']})" for k in keyframes],
        keyframe_camera=(numbers + 1).astype(np.int32),
        cam_from_world=poses,
        offsets=np.searchsorted(row, np.arange(len(keyframes) + 1)).astype(np.int64),
        keypoints=columns["xy"][order] + np.float32(0.5),
        sizes=_SIZES[octaves],
        angles=angles,
        responses=np.zeros(len(order), np.float32),
        octaves=octaves.astype(np.int32),
        descriptors=columns["descriptor"][order],
        landmark_of_keypoint=np.where(known, seen.astype(np.int64), -1),
        landmark_ids=points["id"].astype(np.int64),
        landmark_positions=points["xyz"].astype(np.float64),
        info={
            "source": {**source, **({"dropped": dict(dropped)} if (dropped := +dropped) else {})},
            "detector": {"name": "ORB-SLAM"},
        },
    )


def _ascending(table: NDArray[Any]) -> NDArray[Any]:
    """The rows of a table by id; most tables are sorted already."""
    ids = table["id"]
    return table if (ids[1:] > ids[:-1]).all() else table[np.argsort(ids)]


def _cameras(text: str, features: NDArray[Any] | None, numbers: NDArray[np.uint64]) -> list[Camera]:
    """The cameras of undistorted images."""
    try:
        params = [tuple(map(float, match)) for match in _CAMERA.findall(text)]
    except ValueError:
        raise ValueError("a camera matrix holds something that is no number") from None
    if not params or (numbers >= len(params)).any():
        raise ValueError(f"{len(params)} camera matrices are not those of the keyframes")
    reach = np.zeros(2)
    if features is not None and len(features):
        if not (np.abs(features["xy"]) < _MAX_PIXEL).all():
            raise ValueError("keypoints lie outside any image")
        reach = features["xy"].max(axis=0)
    return [Camera.from_opencv(*_size(np.array(one[2:]), reach), one) for one in params]


def _size(center: NDArray[np.float64], reach: NDArray[np.float64]) -> tuple[int, int]:
    """Width and height of images, which files lack: about twice the principal point.

    A usual size that is nearly that, or what holds all keypoints.
    """
    if not (np.abs(center) < _MAX_PIXEL).all():
        raise ValueError("a camera matrix has a principal point outside any image")
    usual = np.array(_USUAL_SIZES)
    off = np.abs(2 * center / usual - 1).max(axis=1) + (reach > usual).any(axis=1)
    best = usual[off.argmin()] if off.min() <= _SIZE_TOLERANCE else None
    width, height = np.ceil(np.maximum(2 * center, reach + 1)) if best is None else best
    return int(width), int(height)


def _projected(
    keyframes: NDArray[Any],
    points: NDArray[Any],
    cameras: list[Camera],
    numbers: NDArray[np.uint64],
    dropped: Counter[str],
) -> dict[str, NDArray[Any]]:
    """Each landmark as a keypoint of the keyframe whose axis passes it at the smallest angle.

    The columns are those of `_FEATURE`.
    """
    poses = keyframes["pose"].astype(np.float64)
    centers, params = camera_centers(poses), np.array([cameras[int(n)].params for n in numbers])
    keyframe, xy = np.zeros(len(points), np.uint64), np.zeros((len(points), 2), np.float32)
    seen = np.zeros(len(points), bool)
    for begin in range(0, len(points), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        xyz = points["xyz"][rows].astype(np.float64)
        depth = xyz @ poses[:, 2, :3].T + poses[:, 2, 3]
        square = (xyz**2).sum(1)[:, None] - 2 * xyz @ centers.T + (centers**2).sum(1)
        facing = np.where(depth > 0, depth * np.abs(depth) / np.maximum(square, 1e-12), -1)
        nearest = facing.argmax(axis=1)
        local, lens = transform(poses[nearest], xyz), params[nearest]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = local[:, :2] / local[:, 2:] * lens[:, :2] + lens[:, 2:] - 0.5
        seen[rows] = (facing.max(axis=1) > 0) & (np.abs(pixels) < _MAX_PIXEL).all(axis=1)
        keyframe[rows], xy[rows] = keyframes["id"][nearest], pixels
    dropped["descriptors of landmarks that no keyframe faces"] = int((~seen).sum())
    kept = points if seen.all() else points[seen]
    return {
        "keyframe": keyframe[seen],
        "point": kept["id"],
        "octave": np.zeros(len(kept), np.uint8),
        "xy": xy[seen],
        "angle": np.full(len(kept), -1, np.float32),
        "descriptor": kept["descriptor"],
    }
