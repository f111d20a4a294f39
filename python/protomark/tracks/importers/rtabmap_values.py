"""Reads the matrices, motions and calibrations in RTAB-Map's tables.

Their formats were read in RTAB-Map (BSD-3), corelib/src/Compression.cpp, CameraModel.cpp and
StereoCameraModel.cpp.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera

_MAX_DEFLATION = 1100  # zlib makes data at most this many times smaller


def matrix(blob: bytes, dtype: str) -> NDArray[Any]:
    """A cv::Mat of numbers of 4 bytes: deflated, and then rows, columns and type."""
    rows, columns, _ = struct.unpack("<3i", blob[-12:])
    size = 4 * rows * columns
    if not 0 <= size <= _MAX_DEFLATION * len(blob):
        raise ValueError(f"a matrix of {rows} x {columns} numbers in {len(blob)} bytes")
    data = zlib.decompressobj().decompress(blob[:-12], size + 1)
    if len(data) != size:
        raise ValueError(f"a matrix of {rows} x {columns} numbers has {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(rows, columns)


def rigid(blob: bytes) -> NDArray[np.float64] | None:
    """A motion of 12 float32 with an exact rotation; None: RTAB-Map's null, all zeros."""
    pose = np.frombuffer(blob, "<f4").reshape(3, 4).astype(np.float64)
    if not pose.any():
        return None
    if not (np.abs(pose) < 1e9).all():
        raise ValueError("a pose has numbers beyond any scene")
    u, scale, v = np.linalg.svd(pose[:, :3])
    rotation = u @ v
    if np.abs(scale - 1).max() > 0.01 or np.linalg.det(rotation) < 0:
        raise ValueError("a pose is not a rigid motion")
    return np.column_stack([rotation, pose[:, 3]])


def calibration(blob: bytes) -> list[tuple[Camera, NDArray[np.float64]]]:
    """Cameras and base_from_cam (3, 4); the left ones of stereo cameras.

    Images are rectified, so lens distortion does not count.
    """
    found = []
    while blob:
        header = struct.unpack_from("<11i", blob.ljust(44, b"\0"))
        if 0 <= header[0] < 100 and header[3] == 1:
            begin = 40 + 8 * sum(header[4:8])
            left, right = header[8:10]
            if min(header[4:10]) < 0 or left <= 0:
                raise ValueError("a stereo calibration lacks its left camera")
            found += calibration(blob[begin : begin + left])
            blob = blob[begin + left + right :]
            continue
        if 0 <= header[0] < 100 and header[3] == 0:
            _, _, _, _, width, height, k, d, r, p, local = header
            end = 44 + 8 * (k + d + r + p) + 4 * local
            if min(header[6:]) < 0 or end > len(blob) or k not in (0, 9) or p not in (0, 12):
                raise ValueError("a calibration is cut off")
            start, columns = (44 + 8 * (k + d + r), 4) if p else (44, 3)
            matrix = np.frombuffer(blob, "<f8", 3 * columns, start).reshape(3, columns)
            fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
            motion = blob[end - 4 * local : end]
        else:
            # Before 0.18: fx fy cx cy, a baseline if stereo, the size from 0.11.2 on, the motion.
            count = next((n for n in (18, 16, 19, 17) if len(blob) % (4 * n) == 0), 0)
            if not count:
                raise ValueError(f"a calibration of {len(blob)} bytes is of no known version")
            fx, fy, cx, cy, *rest = np.frombuffer(blob, "<f4", count).tolist()
            end = 4 * count
            motion = blob[end - 48 : end]
            width, height = map(int, rest[-14:-12] if count in (18, 19) else (0, 0))
        base_from_cam = rigid(motion)
        if base_from_cam is None:
            raise ValueError("a camera has no place on the robot")
        width, height = width or round(2 * cx), height or round(2 * cy)
        camera = Camera.from_opencv(width, height, (fx, fy, cx, cy))
        found.append((camera, base_from_cam))
        blob = blob[end:]
    return found
