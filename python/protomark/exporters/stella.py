"""Writes tracks as a map of stella_vslam (`.msg`), with one descriptor per landmark.

Each observation of a landmark gets the majority vote of all its descriptors, and keypoints without
a landmark are left out, as the program computes everything else of what remains. The fields were
read in stella_vslam (BSD-2), data/ and io/ at b0e60d6.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.baselines.binary import majority
from protomark.baselines.support import Support
from protomark.files import replacing
from protomark.geometry.camera import Camera
from protomark.geometry.pose import quaternion_from_rotation
from protomark.tracks.file import Tracks

_ROOT = 2**32 - 1  # the parent of the first keyframe
_LEVELS, _SCALE_FACTOR, _FAST, _MIN_FAST = 8, 1.2, 20, 7
# Lens parameters of COLMAP's models by stella_vslam's names.
_LENSES: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("Perspective", ()),
    "PINHOLE": ("Perspective", ()),
    "SIMPLE_RADIAL": ("Perspective", ("k1",)),
    "RADIAL": ("Perspective", ("k1", "k2")),
    "OPENCV": ("Perspective", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("Perspective", ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": ("Fisheye", ("k1", "k2", "k3", "k4")),
}


def write_stella(tracks: Tracks, output: Path) -> dict[str, Any]:
    """Write a map; returns what it holds.

    Raises:
        ValueError: descriptors are not ORB's, or stella_vslam has no such camera.
    """
    if (tracks.descriptor, tracks.bits) != ("orb", 256):
        raise ValueError(
            f"stella_vslam reads ORB only, and these tracks hold {tracks.descriptor} of "
            f"{tracks.bits} bits"
        )
    if not len(tracks.observations):
        raise ValueError("the tracks hold no observations, so there is no map to write")
    if tracks.landmark_ids[-1] >= _ROOT or (tracks.octaves < 0).any():
        raise ValueError("landmark ids need 32 bits at most, and octaves must not be negative")
    seen, undistorted = _observations(tracks)
    landmarks = tracks.landmark_of_keypoint[seen]
    voted = majority(Support(landmarks, tracks.descriptors[seen]))
    descriptors = voted.descriptors[np.searchsorted(voted.landmarks, landmarks)].view("<u4")
    keyframe = tracks.keyframe_of_keypoint[seen]
    numbers, starts = np.unique(keyframe, return_index=True)
    rows = dict(zip(numbers.tolist(), np.split(np.arange(len(seen)), starts[1:]), strict=True))
    parents = _spanning_tree({i: landmarks[r] for i, r in rows.items()})
    keyframes = {}
    for i, own in rows.items():
        xy, angles = undistorted[own], tracks.angles[seen[own]]
        w, x, y, z = quaternion_from_rotation(tracks.cam_from_world[i, :, :3])
        keyframes[str(i)] = {
            "ts": float(i),
            "cam": f"camera {int(tracks.keyframe_camera[i])}",
            "orb_params": "protomark",
            "rot_cw": [x, y, z, w],
            "trans_cw": tracks.cam_from_world[i, :, 3].tolist(),
            "n_keypts": len(own),
            "undist_keypts": [
                {"pt": at, "ang": angle, "oct": octave}
                for at, angle, octave in zip(
                    xy.tolist(), angles.tolist(), tracks.octaves[seen[own]].tolist(), strict=True
                )
            ],
            "x_rights": [],
            "depths": [],
            "descs": descriptors[own].tolist(),
            "lm_ids": landmarks[own].tolist(),
            "span_parent": parents[i],
            "span_children": [child for child, parent in parents.items() if parent == i],
            "loop_edges": [],
        }
    ids, first, counts = np.unique(landmarks, return_index=True, return_counts=True)
    positions = tracks.positions_of(ids)
    records = {}
    for landmark, begin, count, at in zip(
        ids.tolist(), keyframe[first].tolist(), counts.tolist(), positions.tolist(), strict=True
    ):
        records[str(landmark)] = {
            **{"1st_keyfrm": begin, "pos_w": at, "ref_keyfrm": begin},
            **{"n_vis": count, "n_fnd": count},
        }
    detector = tracks.info.get("detector", {})
    orb = {
        "name": "protomark",
        "num_levels": int(detector.get("levels", max(_LEVELS, int(tracks.octaves.max()) + 1))),
        "scale_factor": float(detector.get("scale_factor", _SCALE_FACTOR)),
        "ini_fast_threshold": int(detector.get("fast_threshold", _FAST)),
        "min_fast_threshold": int(detector.get("min_fast_threshold", _MIN_FAST)),
    }
    content = {
        "cameras": {f"camera {i}": _camera(c) for i, c in tracks.cameras.items()},
        "orb_params": {"protomark": orb},
        "keyframes": keyframes,
        "landmarks": records,
        "keyframe_next_id": int(numbers[-1]) + 1,
        "landmark_next_id": int(ids[-1]) + 1,
    }
    with replacing(output) as file:
        file.write(_packed(content))
    return {
        "images": len(keyframes),
        "landmarks": len(records),
        "observations": len(seen),
        "dropped_keypoints": len(tracks.keypoints) - len(seen),
        "bytes": output.stat().st_size,
    }


def _observations(tracks: Tracks) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the keypoints to keep, one per keyframe and landmark, and where they are undistorted.

    Keypoints that no lens without distortion shows are left out.
    """
    rows = tracks.observations
    pairs = np.column_stack([tracks.keyframe_of_keypoint[rows], tracks.landmark_of_keypoint[rows]])
    rows = rows[np.sort(np.unique(pairs, axis=0, return_index=True)[1])]
    xy = np.full((len(rows), 2), np.nan)
    camera_of_row = tracks.keyframe_camera[tracks.keyframe_of_keypoint[rows]]
    for number, camera in tracks.cameras.items():
        own = camera_of_row == number
        if own.any():
            xy[own] = _undistorted(camera, tracks.keypoints[rows[own]].astype(np.float64))
    kept = np.isfinite(xy).all(axis=1)
    return rows[kept], xy[kept]


def _spanning_tree(landmarks: dict[int, NDArray[np.int64]]) -> dict[int, int]:
    """For each keyframe the earlier one that shares most of its landmarks; a tree of all."""
    parents: dict[int, int] = {}
    for i, own in landmarks.items():
        shared = {j: np.isin(own, landmarks[j]).sum() for j in parents}
        parents[i] = max(shared, key=shared.__getitem__) if shared else _ROOT
    return parents


def _pinhole(camera: Camera) -> list[float]:
    """fx, fy, cx, cy, and the parameters of the lens."""
    one = camera.model.startswith("SIMPLE") or camera.model == "RADIAL"
    return [camera.params[0], *camera.params] if one else list(camera.params)


def _camera(camera: Camera) -> dict[str, Any]:
    common = {"setup_type": "Monocular", "color_order": "Gray", "fps": 30.0}
    common |= {"cols": camera.width, "rows": camera.height, "focal_x_baseline": 0.0}
    if camera.model == "EQUIRECTANGULAR":
        return {"model_type": "Equirectangular", **common}
    if camera.model not in _LENSES or (camera.model == "FULL_OPENCV" and any(camera.params[9:])):
        raise ValueError(f"stella_vslam has no camera {camera.model}")
    kind, names = _LENSES[camera.model]
    fx, fy, cx, cy, *lens = _pinhole(camera)
    every = ("k1", "k2", "k3", "k4") if kind == "Fisheye" else ("k1", "k2", "p1", "p2", "k3")
    values = dict(zip(names, lens, strict=False))
    # The centre of its first pixel is (0, 0).
    return {
        "model_type": kind,
        **common,
        **{"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5},
        **{name: values.get(name, 0.0) for name in every},
    }


def _undistorted(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keypoints (n, 2) as stella_vslam keeps them: of a lens without distortion."""
    if camera.model == "EQUIRECTANGULAR":
        return points
    fx, fy, cx, cy = _pinhole(camera)[:4]
    return np.asarray(camera.rays(points) * [fx, fy] + [cx - 0.5, cy - 0.5])


def _packed(value: Any) -> bytes:
    """A JSON value as MessagePack (https://github.com/msgpack/msgpack, spec.md)."""
    if isinstance(value, float):
        short = struct.pack(">Bf", 0xCA, value) if abs(value) < 1e38 else b""
        exact = short and struct.unpack(">f", short[1:])[0] == value
        return short if exact else struct.pack(">Bd", 0xCB, value)
    if isinstance(value, int):
        if value < 128:
            return bytes([value])
        size, kind = next((s, k) for s, k in enumerate("BHIQ") if value < 256 ** (1 << s))
        return struct.pack(f">B{kind}", 0xCC + size, value)
    if isinstance(value, str):
        data = value.encode()
        return _head(len(data), 0xA0, 32, 0xDA, 0xDB) + data
    if isinstance(value, dict):
        pairs = (part for item in value.items() for part in item)
        return _head(len(value), 0x80, 16, 0xDE, 0xDF) + b"".join(map(_packed, pairs))
    return _head(len(value), 0x90, 16, 0xDC, 0xDD) + b"".join(map(_packed, value))


def _head(length: int, short: int, limit: int, two: int, four: int) -> bytes:
    if length < limit:
        return bytes([short | length])
    return struct.pack(">BH", two, length) if length < 2**16 else struct.pack(">BI", four, length)
