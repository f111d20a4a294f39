"""Reads maps of NASA's Astrobee (.map).

The format was read in Astrobee (Apache-2.0), localization/sparse_mapping (sparse_map.proto,
sparse_map.cc, protobuf_utilities.cc) and localization/camera/src/camera_params.cc; no map of the
program itself was at hand. A file holds protobuf messages, each after its length: one with counts,
cameras, frames, landmarks, and a vocabulary that is not read. Keypoints are undistorted, and
relative to the optical axis.
"""

from __future__ import annotations

from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Features
from protomark.files import hash_files
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks
from protomark.tracks.importers.binary import Reader
from protomark.tracks.importers.binary_descriptors import binary_descriptor, refusal
from protomark.tracks.importers.keyframes import (
    Keyframe,
    checked_features,
    distort,
    join,
    unexpected,
)
from protomark.tracks.importers.protobuf import BYTES, FIXED64, VARINT, fields, varint

PROGRAM = "Astrobee"

# Fields of the first message.
_DETECTOR, _CAMERA, _DEPTH, _FRAMES, _LANDMARKS, _EQUALIZATION, _CAMERAS = 2, 3, 4, 5, 6, 9, 10
_MAX_LAYOUTS = 16
_EQUALIZATIONS = {0: "none", 1: "histogram", 3: "CLAHE"}


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a file that begins with `head` is a map of Astrobee."""
    try:
        found = _header(Reader(head, path))
    except ValueError:
        return False
    return {_DETECTOR, _DEPTH, _FRAMES, _LANDMARKS} <= found.keys()


def read(path: Path) -> Tracks:
    """Read a map.

    A landmark's id is its place in the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: its descriptors are not binary, or the file is broken.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such map of {PROGRAM}")
    with unexpected(path, "map"):
        header, lenses, frames, positions, seen = _messages(Reader(path.read_bytes(), path))
        detector = header[_DETECTOR].decode("ascii")
        cameras = {i: _camera(lens) for i, lens in enumerate(lenses, 1)}
    dropped: Counter[str] = Counter()
    labels = [np.full(len(frame["xy"]), -1, np.int64) for frame in frames]
    for landmark, at, feature in np.array(seen, np.int64).reshape(-1, 3).tolist():
        if at < len(labels) and feature < len(labels[at]):
            labels[at][feature] = landmark
        else:
            dropped["observations of missing keypoints"] += 1
    kinds = {f["descriptors"].shape[1] for f in frames if len(f["xy"])}
    names = {binary_descriptor(detector, "uint8", size) for size in kinds}
    kind = names.pop() if len(names) == 1 else None
    if kinds and kind is None:
        raise refusal(path, PROGRAM, [f"{detector} ({', '.join(map(str, kinds))} bytes)"])
    keyframes = []
    for i, frame in enumerate(frames):
        name, number = frame["name"] or f"keyframe{i}", frame["camera"] + 1
        if "pose" not in frame or number not in cameras:
            dropped["keyframes without pose or camera"] += 1
            continue
        with unexpected(path, f"frame {name}"):
            features = _features(frame, lenses[number - 1], cameras[number])
        keyframes.append(Keyframe(name, number, frame["pose"], features, labels[i]))
    source: dict[str, Any] = {"program": PROGRAM, "version": "unknown"}
    source |= {"digest": hash_files([("map", path)]), "dropped": dict(dropped)}
    settings = {"name": detector}
    if header.get(_EQUALIZATION) in _EQUALIZATIONS:
        settings["equalization"] = _EQUALIZATIONS[header[_EQUALIZATION]]
    info = {"source": source, "detector": settings}
    frames.clear()
    landmarks = np.arange(len(positions) // 3), np.array(positions)
    return join(path, kind or "", cameras, keyframes, landmarks, info)


def _messages(
    reader: Reader,
) -> tuple[
    dict[int, Any], list[dict[str, list[float]]], list[dict[str, Any]], array[float], array[int]
]:
    """The counts, lenses, frames, positions of landmarks, and observations of a file."""
    reader.where = "counts"
    header = _header(reader)
    if header.get(_DEPTH, 0) != 0:
        raise refusal(reader.path, PROGRAM, [header[_DETECTOR].decode("ascii")])
    reader.where = "cameras"
    if _CAMERAS in header:
        lenses = [_lens(reader, varint(reader)) for _ in range(_count(reader, header[_CAMERAS]))]
    else:
        lenses = [_lens(Reader(header[_CAMERA], reader.path), None)]
    reader.where = "frames"
    frames = [_frame(reader, varint(reader)) for _ in range(_count(reader, header[_FRAMES]))]
    reader.where = "landmarks"
    positions, seen = array("d"), array("q")
    for number in range(_count(reader, header[_LANDMARKS])):
        positions.extend(_landmark(reader, varint(reader), number, seen))
    return header, lenses, frames, positions, seen


def _count(reader: Reader, number: int) -> int:
    """A number of messages, each of which takes a byte at least."""
    if not 0 <= number <= len(reader):
        reader.fail(f"{number:,} messages should follow in {len(reader):,} bytes")
    return number


def _header(reader: Reader) -> dict[int, Any]:
    size = varint(reader)
    if size > len(reader):
        reader.fail(f"a message of {size:,} bytes should follow: cut off, or no map of {PROGRAM}")
    out: dict[int, Any] = {}
    for number, wire, value in fields(reader, size):
        if wire == BYTES:
            out[number] = bytes(reader.take(value))
        elif wire == VARINT:
            out[number] = value
    return out


def _numbers(reader: Reader, length: int | None) -> dict[int, list[float]]:
    """The numbers of a message that holds nothing else, by field."""
    out: dict[int, list[float]] = {}
    for number, wire, value in fields(reader, length):
        found = out.setdefault(number, [])
        if wire == VARINT:
            found.append(value)
        elif wire == FIXED64:
            found.append(float(np.frombuffer(value, "<f8")[0]))
        elif wire == BYTES:  # numbers in a row
            found += np.frombuffer(reader.take(value), "<f8").tolist()
    return out


def _lens(reader: Reader, length: int | None) -> dict[str, list[float]]:
    """Focal length, principal point, size and distortion."""
    names = {1: "focal", 2: "middle", 3: "size", 5: "distortion"}
    found = _numbers(reader, length)
    return {name: found.get(number, []) for number, name in names.items()}


def _camera(lens: dict[str, list[float]]) -> Camera:
    (width, height), lengths = map(int, lens["size"]), lens["distortion"]
    (fx, fy), (cx, cy) = lens["focal"], lens["middle"]
    if len(lengths) == 1:
        camera = Camera("FOV", width, height, (fx, fy, cx + 0.5, cy + 0.5, lengths[0]))
        camera.check()
        return camera
    if len(lengths) not in (0, 2, 4, 5):
        raise ValueError(f"a camera with {len(lengths)} coefficients of distortion")
    return Camera.from_opencv(width, height, (fx, fy, cx, cy), lengths, len(lengths) == 2)


def _frame(reader: Reader, length: int) -> dict[str, Any]:
    out: dict[str, Any] = {"name": "", "camera": 0}
    spans: list[tuple[int, int]] = []
    for number, wire, value in fields(reader, length):
        if (number, wire) == (1, BYTES):
            out["name"] = bytes(reader.take(value)).decode()
        elif (number, wire) == (2, BYTES):
            spans.append((reader.offset, value))
        elif (number, wire) == (3, BYTES):
            pose = _numbers(reader, value)
            matrix = np.array([pose[i][0] for i in range(1, 10)]).reshape(3, 3)
            shift = np.array([pose[i][0] for i in range(10, 13)])
            # A scaled map has scaled cameras, which see the same.
            scale = np.cbrt(np.linalg.det(matrix)) or 1.0
            out["pose"] = np.column_stack([matrix, shift]) / scale
        elif (number, wire) == (4, VARINT):
            out["camera"] = value
    end = reader.offset
    out["xy"], out["descriptors"] = _keypoints(reader, np.array(spans, np.int64).reshape(-1, 2))
    reader.offset = end
    return out


def _keypoints(
    reader: Reader, spans: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions (n, 2) and descriptors of messages that begin at bytes, and have lengths (n, 2).

    Messages of the same layout are read at once.
    """
    data = np.frombuffer(reader.data, np.uint8)
    xy, descriptors = np.zeros((len(spans), 2)), np.zeros((len(spans), 1), np.uint8)
    waiting = np.arange(len(spans))
    for _ in range(_MAX_LAYOUTS):
        if not len(waiting):
            return xy, descriptors
        begin, length = map(int, spans[waiting[0]])
        places = _layout(reader, begin, length)
        size = places[3][1]
        if size != descriptors.shape[1]:
            if len(waiting) < len(spans):
                reader.fail(f"descriptors of {descriptors.shape[1]} and {size} bytes in a frame")
            descriptors = np.zeros((len(spans), size), np.uint8)
        alike = waiting[spans[waiting, 1] == length]
        rows = data[spans[alike, :1] + np.arange(length)]
        fixed = np.ones(length, bool)
        for at, count in places.values():
            fixed[at : at + count] = False
        same = (rows[:, fixed] == rows[0, fixed]).all(axis=1)
        alike, rows = alike[same], rows[same]
        for field, column in ((1, 0), (2, 1)):
            at = places[field][0]
            xy[alike, column] = np.ascontiguousarray(rows[:, at : at + 8]).view("<f8")[:, 0]
        at = places[3][0]
        descriptors[alike] = rows[:, at : at + size]
        waiting = np.setdiff1d(waiting, alike, assume_unique=True)
    reader.fail("the features of a frame differ too much")


def _layout(reader: Reader, begin: int, length: int) -> dict[int, tuple[int, int]]:
    """Where a feature has its values: byte and length, by field."""
    reader.offset = begin
    out = {}
    for number, wire, value in fields(reader, length):
        if wire == BYTES:
            out[number] = (reader.offset - begin, value)
        elif wire != VARINT:
            out[number] = (reader.offset - begin - len(value), len(value))
    if not {1, 2, 3} <= out.keys() or (out[1][1], out[2][1]) != (8, 8) or not out[3][1]:
        reader.fail("a feature has no x, y or descriptor")
    return out


def _landmark(reader: Reader, length: int, number: int, seen: array[int]) -> list[float]:
    """The position of a landmark; observations are appended as landmark, frame and feature."""
    position: list[float] = []
    for field, wire, value in fields(reader, length):
        if (field, wire) == (1, BYTES):
            found = _numbers(reader, value)
            position = [found[i][0] for i in (1, 2, 3)]
        elif (field, wire) == (2, BYTES):
            match = {f: v for f, w, v in fields(reader, value) if w == VARINT}
            seen.extend((number, match[1], match[2]))
    if not position:
        reader.fail("a landmark has no position")
    return position


def _features(frame: dict[str, Any], lens: dict[str, list[float]], camera: Camera) -> Features:
    middle = np.array(lens["middle"]) + 0.5
    xy = distort(camera, frame["xy"] + middle, lens["focal"], middle)
    sizes = np.ones(len(xy))  # not in the file
    return checked_features(xy, frame["descriptors"], sizes)
