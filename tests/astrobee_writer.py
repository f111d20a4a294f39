"""Writes tracks as Astrobee does, in protobuf."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from protomark.tracks.file import Tracks


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def field(number: int, value: Any) -> bytes:
    if isinstance(value, (bytes, str)):
        data = value.encode() if isinstance(value, str) else value
        return varint(number << 3 | 2) + varint(len(data)) + data
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    return varint(number << 3) + varint(value)


def message(values: list[tuple[int, Any]]) -> bytes:
    return b"".join(field(number, value) for number, value in values)


def write_astrobee(
    path: Path, tracks: Tracks, detector: str = "ORGBRISK", old: bool = False, scale: float = 1.0
) -> None:
    """Write a map, an old one with its only camera in the first message."""
    camera = next(iter(tracks.cameras.values()))
    fx, fy, cx, cy, *lens = camera.params
    if camera.model == "FULL_OPENCV":
        lens = lens[:5]
    if camera.model == "OPENCV_FISHEYE":
        lens = lens[:2]
    size = [(3, camera.width), (3, camera.height), (4, camera.width), (4, camera.height)]
    numbers = [(1, fx), (1, fy), (2, cx - 0.5), (2, cy - 0.5), *size, *((5, k) for k in lens)]
    camera_message = message(numbers)
    counts = [(4, 0), (5, len(tracks.keyframe_names)), (6, len(tracks.landmark_ids)), (9, 1)]
    one = [(3, camera_message)] if old else []
    many = [] if old else [(10, 1)]
    parts = [message([(2, detector), *one, *counts, *many])]
    parts += [] if old else [camera_message]
    rays = camera.rays(tracks.keypoints) * (fx, fy)
    for i, name in enumerate(tracks.keyframe_names):
        features = [
            field(2, message([(1, float(x)), (2, float(y)), (3, tracks.descriptors[r].tobytes())]))
            for r, (x, y) in enumerate(rays)
            if tracks.offsets[i] <= r < tracks.offsets[i + 1]
        ]
        pose = scale * tracks.cam_from_world[i]
        matrix = [*pose[:, :3].ravel().tolist(), *pose[:, 3].tolist()]
        end = message([(3, message(list(enumerate(matrix, 1)))), (4, 0)])
        parts.append(field(1, name) + b"".join(features) + end)
    keyframe = tracks.keyframe_of_keypoint
    for landmark, xyz in zip(tracks.landmark_ids, tracks.landmark_positions, strict=True):
        rows = np.flatnonzero(tracks.landmark_of_keypoint == landmark).tolist()
        seen = [(int(keyframe[r]), int(r - tracks.offsets[keyframe[r]])) for r in rows]
        place = message(list(enumerate(xyz.tolist(), 1)))
        matches = [(2, message([(1, k), (2, f)])) for k, f in seen]
        parts.append(message([(1, place), *matches]))
    parts.append(b"a vocabulary")
    path.write_bytes(b"".join(varint(len(part)) + part for part in parts))
