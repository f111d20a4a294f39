"""Writes tracks as OpenMVG does: sfm_data as JSON or binary, .feat and .desc."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from protomark.geometry.pose import camera_centers
from protomark.tracks.file import Tracks

NEW = 1 << 31


def camera_of(tracks: Tracks) -> tuple[str, str, list[float]]:
    """The type of the camera in OpenMVG, and its distortion's name and numbers."""
    camera = next(iter(tracks.cameras.values()))
    k = [*camera.params[4:], *[0.0] * 8]
    if camera.model == "OPENCV_FISHEYE":
        return "fisheye", "fisheye", k[:4]
    if camera.model == "PINHOLE":
        return "pinhole", "", []
    if k[2] or k[3]:
        return "pinhole_brown_t2", "disto_t2", [k[0], k[1], k[4], k[2], k[3]]
    if k[1] or k[4]:
        return "pinhole_radial_k3", "disto_k3", [k[0], k[1], k[4]]
    return "pinhole_radial_k1", "disto_k1", [k[0]]


def observations(tracks: Tracks, landmark: int) -> list[tuple[int, int, list[float]]]:
    """View, row of the keypoint, and pixel of each observation of a landmark."""
    keyframe = tracks.keyframe_of_keypoint
    rows = np.flatnonzero(tracks.landmark_of_keypoint == landmark).tolist()
    return [
        (
            int(keyframe[r]),
            int(r - tracks.offsets[keyframe[r]]),
            (tracks.keypoints[r].astype(float) - 0.5).tolist(),
        )
        for r in rows
    ]


def write_json(path: Path, tracks: Tracks) -> None:
    """Write version 0.3."""
    camera = next(iter(tracks.cameras.values()))
    kind, name, lens = camera_of(tracks)
    f, _, cx, cy = camera.params[:4]
    intrinsic: dict[str, Any] = {"width": camera.width, "height": camera.height}
    intrinsic |= {"focal_length": f, "principal_point": [cx - 0.5, cy - 0.5]}
    intrinsic |= {name: lens} if name else {}
    views = [
        {"local_path": "", "filename": n, "width": 1, "height": 1, "id_view": i}
        | {"id_intrinsic": 0, "id_pose": i}
        for i, n in enumerate(tracks.keyframe_names)
    ]
    whole = {
        "sfm_data_version": "0.3",
        "root_path": "/images",
        "views": [
            {
                "key": i,
                "value": {
                    "polymorphic_id": 1 << 30,
                    "ptr_wrapper": {"id": NEW + i + 1, "data": view},
                },
            }
            for i, view in enumerate(views)
        ],
        "intrinsics": [
            {
                "key": 0,
                "value": {
                    "polymorphic_id": NEW + 1,
                    "polymorphic_name": kind,
                    "ptr_wrapper": {"id": NEW + 9, "data": intrinsic},
                },
            }
        ],
        "extrinsics": [
            {
                "key": i,
                "value": {"rotation": p[:, :3].tolist(), "center": camera_centers(p).tolist()},
            }
            for i, p in enumerate(tracks.cam_from_world)
        ],
        "structure": [
            {
                "key": i,
                "value": {
                    "X": xyz,
                    "observations": [
                        {"key": view, "value": {"id_feat": row, "x": xy}}
                        for view, row, xy in observations(tracks, i)
                    ],
                },
            }
            for i, xyz in zip(
                tracks.landmark_ids.tolist(), tracks.landmark_positions.tolist(), strict=True
            )
        ],
        "control_points": [],
    }
    path.write_text(json.dumps(whole, indent=4))


def text(value: str) -> bytes:
    return struct.pack("<Q", len(value)) + value.encode()


def vector(values: Any) -> bytes:
    return struct.pack(f"<Q{len(values)}d", len(values), *values)


def write_binary(path: Path, tracks: Tracks, version: str = "0.2", kind: str = "view") -> None:
    """Write cereal's portable binary; views are of a type, with or without priors."""
    camera = next(iter(tracks.cameras.values()))
    name, _, lens = camera_of(tracks)
    f, _, cx, cy = camera.params[:4]
    out = b"\1" + text(version) + text("/images")
    out += struct.pack("<Q", len(tracks.keyframe_names))
    priors = kind.startswith("view_priors")
    for i, image in enumerate(tracks.keyframe_names):
        out += struct.pack("<I", i)
        if version == "0.3" and priors:
            out += struct.pack("<I", (0 if i else NEW) + 5) + (b"" if i else text("view_priors"))
        elif version == "0.3":
            out += struct.pack("<I", 1 << 30)
        out += struct.pack("<I", NEW + i + 1) + text("/") + text(image)
        out += struct.pack("<5I", camera.width, camera.height, i, 0, i)
        if kind == "view_priors used":
            out += b"\1" + vector([1, 1, 1]) + vector([0, 0, 0])
    out += struct.pack("<QII", 1, 0, NEW + 2) + text(name)
    out += struct.pack("<IIId", NEW + 99, camera.width, camera.height, f)
    out += vector([cx - 0.5, cy - 0.5]) + (vector(lens) if lens else b"")
    out += struct.pack("<Q", len(tracks.keyframe_names))
    for i, pose in enumerate(tracks.cam_from_world):
        out += struct.pack("<IQ", i, 3) + b"".join(map(vector, pose[:, :3]))
        out += vector(camera_centers(pose))
    out += struct.pack("<Q", len(tracks.landmark_ids))
    for i, xyz in zip(tracks.landmark_ids.tolist(), tracks.landmark_positions, strict=True):
        seen = observations(tracks, i)
        out += struct.pack("<I", i) + vector(xyz) + struct.pack("<Q", len(seen))
        for view, row, xy in seen:
            out += struct.pack("<II", view, row) + vector(xy)
    path.write_bytes(out + struct.pack("<Q", 0))


def write_features(folder: Path, tracks: Tracks, width: int = 64) -> None:
    """Write a .feat and a .desc for each image."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(tracks.keyframe_names):
        rows = tracks.keypoints_of(i)
        xy = tracks.keypoints[rows].astype(float) - 0.5
        shape = [xy, tracks.sizes[rows] / 2, np.radians(tracks.angles[rows])]
        lines = [" ".join(map(repr, row)) for row in np.column_stack(shape).tolist()]
        base = folder / name
        base.with_suffix(".feat").write_text("\n".join(lines) + "\n")
        data = np.zeros((len(xy), width), np.uint8)
        data[:, :61] = tracks.descriptors[rows]
        count = struct.pack("<Q", len(xy))
        base.with_suffix(".desc").write_bytes(count + data.tobytes())
