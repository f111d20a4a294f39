"""Writes tracks as stella_vslam does, `.msg` of each version and `.db`."""

from __future__ import annotations

import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np

from protomark.geometry.pose import quaternion_from_rotation
from protomark.tracks.file import Tracks

VERSIONS = ("before 0.3.0", "0.3.0 to 0.3.2", "0.3.3 to 0.3.7", "0.3.8 or later")
SETTINGS = {
    "num_levels": 8,
    "scale_factor": float(np.float32(1.2)),
    "ini_fast_threshold": 20,
    "min_fast_threshold": 7,
}


def pack(value: Any) -> bytes:
    """MessagePack as nlohmann::json writes it: sorted keys, numbers as short as they can be."""
    if value is None or isinstance(value, bool):
        return {None: b"\xc0", False: b"\xc2", True: b"\xc3"}[value]
    if isinstance(value, int):
        for form, marker, low, high in (
            *(("B", None, 0, 2**7), ("b", None, -(2**5), 0), ("B", 0xCC, 0, 2**8)),
            *((">H", 0xCD, 0, 2**16), (">I", 0xCE, 0, 2**32), (">Q", 0xCF, 0, 2**64)),
            *(("b", 0xD0, -(2**7), 0), (">h", 0xD1, -(2**15), 0), (">i", 0xD2, -(2**31), 0)),
        ):
            if low <= value < high:
                return (b"" if marker is None else bytes([marker])) + struct.pack(form, value)
    if isinstance(value, float):
        short = float(np.float32(value)) == value
        return struct.pack(">Bf" if short else ">Bd", 0xCA if short else 0xCB, value)
    if isinstance(value, str):
        text = value.encode()
        head = bytes([0xA0 + len(text)]) if len(text) < 32 else bytes([0xD9, len(text)])
        return head + text
    n, is_map = len(value), isinstance(value, dict)
    head = bytes([(0x80 if is_map else 0x90) + n % 16])
    if n > 15:
        head = struct.pack(">BH", 0xDE if is_map else 0xDC, n)
    if n > 65535:
        head = struct.pack(">BI", 0xDF if is_map else 0xDD, n)
    if is_map:
        return head + b"".join(pack(k) + pack(value[k]) for k in sorted(value))
    return head + b"".join(map(pack, value))


def camera_values(tracks: Tracks) -> dict[str, Any]:
    """stella_vslam's words for the camera of tracks, which have one."""
    camera = next(iter(tracks.cameras.values()))
    out: dict[str, Any] = {"cols": camera.width, "rows": camera.height, "fps": 30.0}
    out |= {"setup_type": "Monocular", "color_order": "RGB", "focal_x_baseline": 0.0}
    if camera.model == "EQUIRECTANGULAR":
        return out | {"model_type": "Equirectangular"}
    fx, fy, cx, cy, *lens = camera.params
    model, names = {
        "PINHOLE": ("Perspective", ()),
        "OPENCV": ("Perspective", ("k1", "k2", "p1", "p2")),
        "FULL_OPENCV": ("Perspective", ("k1", "k2", "p1", "p2", "k3")),
        "OPENCV_FISHEYE": ("Fisheye", ("k1", "k2", "k3", "k4")),
        "DIVISION": ("RadialDivision", ("distortion",)),
    }[camera.model]
    if model == "Perspective":
        out |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    out |= {"model_type": model, "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    return out | dict(zip(names, lens, strict=False))


def _pixels(tracks: Tracks, undistorted: bool) -> np.ndarray[Any, np.dtype[np.float32]]:
    camera = next(iter(tracks.cameras.values()))
    if camera.model == "EQUIRECTANGULAR":
        return tracks.keypoints
    if not undistorted:
        return tracks.keypoints - np.float32(0.5)
    fx, fy, cx, cy = camera.params[:4]
    xy = camera.rays(tracks.keypoints) * (fx, fy) + (cx - 0.5, cy - 0.5)
    return xy.astype(np.float32)


def write_msg(path: Path, tracks: Tracks, version: str = VERSIONS[-1], scale: float = 1.2) -> None:
    """Write a `.msg` of a version."""
    age = VERSIONS.index(version)
    raw, straight = _pixels(tracks, False).tolist(), _pixels(tracks, True).tolist()
    words = tracks.descriptors.view("<u4").tolist()
    keyframes = {}
    for i in range(len(tracks.keyframe_names)):
        rows = range(*tracks.keypoints_of(i).indices(len(raw)))
        pose = tracks.cam_from_world[i]
        w, x, y, z = quaternion_from_rotation(pose[:, :3]).tolist()
        points = [
            {"ang": float(tracks.angles[r]), "oct": int(tracks.octaves[r]), "pt": xy}
            for r, xy in zip(
                rows, (straight if age >= 2 else raw)[rows.start : rows.stop], strict=True
            )
        ]
        k: dict[str, Any] = {
            **{"cam": "camera", "ts": i / 30, "n_keypts": len(points), "depths": []},
            **{"rot_cw": [x, y, z, w], "trans_cw": pose[:, 3].tolist(), "loop_edges": []},
            **{"descs": [words[r] for r in rows], "span_children": [], "span_parent": 2**32 - 1},
            "lm_ids": tracks.landmark_of_keypoint[rows.start : rows.stop].tolist(),
            "x_rights": [-1.0] * len(points),
        }
        if age < 2:
            k |= {"keypts": points, "undists": straight[rows.start : rows.stop]}
        else:
            k["undist_keypts"] = points
        if age < 3:
            k["src_frm_id"] = i
        k |= {"orb_params": "ORB"} if age else {"n_scale_levels": 8, "scale_factor": scale}
        keyframes[str(i)] = k
    landmarks = {
        str(i): {"pos_w": xyz.tolist(), "1st_keyfrm": 0, "ref_keyfrm": 0, "n_vis": 3, "n_fnd": 3}
        for i, xyz in zip(tracks.landmark_ids.tolist(), tracks.landmark_positions, strict=True)
    }
    whole = {
        **{"cameras": {"camera": camera_values(tracks)}, "keyframes": keyframes},
        **{"landmarks": landmarks, "keyframe_next_id": len(keyframes), "landmark_next_id": 9999},
    }
    whole |= {"orb_params": {"ORB": SETTINGS}} if age else {"frame_next_id": 99}
    path.write_bytes(pack(whole))


def write_db(path: Path, tracks: Tracks) -> None:
    """Write a `.db`."""
    camera = camera_values(tracks)
    lens = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "distortion")
    names = ("setup_type", "model_type", "cols", "rows", "fps", *lens)
    connection = sqlite3.connect(path)
    connection.executescript(f"""
        CREATE TABLE cameras(id INTEGER PRIMARY KEY, name BLOB, {", ".join(names)});
        CREATE TABLE keyframes(id INTEGER PRIMARY KEY, src_frm_id INTEGER, ts REAL, cam BLOB,
            orb_params BLOB, pose_cw BLOB, n_keypts INTEGER, undist_keypts BLOB, descs BLOB);
        CREATE TABLE landmarks(id INTEGER PRIMARY KEY, first_keyfrm INTEGER, pos_w BLOB);
        CREATE TABLE associations(id INTEGER PRIMARY KEY, lm_ids BLOB, span_parent INTEGER);
    """)
    values = [v.encode() if isinstance(v := camera.get(n), str) else v for n in names]
    marks = ", ".join("?" * (len(names) + 2))
    connection.execute(f"INSERT INTO cameras VALUES ({marks})", (0, b"camera", *values))
    points = np.zeros(
        len(tracks.keypoints),
        [
            *((n, "<f4") for n in ("x", "y", "size", "angle", "response")),
            ("oct", "<i4"),
            ("c", "<i4"),
        ],
    )
    points["x"], points["y"] = _pixels(tracks, True).T
    points["size"], points["angle"], points["oct"] = tracks.sizes, tracks.angles, tracks.octaves
    points["response"] = tracks.responses
    for i in range(len(tracks.keyframe_names)):
        rows = tracks.keypoints_of(i)
        pose = np.vstack([tracks.cam_from_world[i], [0, 0, 0, 1]]).T.tobytes()
        keyframe = (i, None, i / 30, b"camera", b"ORB", pose, rows.stop - rows.start)
        blobs = (points[rows].tobytes(), tracks.descriptors[rows].tobytes())
        connection.execute("INSERT INTO keyframes VALUES (?,?,?,?,?,?,?,?,?)", (*keyframe, *blobs))
        ids = tracks.landmark_of_keypoint[rows].astype("<i4").tobytes()
        connection.execute("INSERT INTO associations VALUES (?,?,-1)", (i, ids))
    for number, xyz in zip(tracks.landmark_ids.tolist(), tracks.landmark_positions, strict=True):
        connection.execute("INSERT INTO landmarks VALUES (?,0,?)", (number, xyz.tobytes()))
    connection.commit()
    connection.close()
