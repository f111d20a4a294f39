"""Reads ORB-SLAM3's atlases (.osa)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.files import hash_files
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks
from protomark.tracks.importers.boost import is_archive
from protomark.tracks.importers.orbslam3_atlas import NAMED, Atlas, AtlasReader, Keyframe, Lens, Map

PROGRAM = "ORB-SLAM3"
_MAX_ID = 2**63 - 1
_MAX_SIDE = 1 << 16  # pixels


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a file is an archive of the library that ORB-SLAM3 writes with."""
    return is_archive(head)


def read(path: Path) -> Tracks:
    """Read all maps of an atlas that hold landmarks.

    Each map has a world of its own, and `info` has the range of its landmarks' ids. A keyframe of
    two fisheye cameras becomes two. Observations are those that the landmarks name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is broken, of a fork, or holds no landmarks.
    """
    atlas = AtlasReader(path.read_bytes(), path).atlas()
    try:
        tracks = _tracks(atlas)
        tracks.check()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    tracks.info["source"]["digest"] = hash_files([(path.name, path)])
    return tracks


def _tracks(atlas: Atlas) -> Tracks:
    dropped: Counter[str] = Counter()
    maps = [_without_bad(one, dropped) for one in sorted(atlas.maps, key=lambda one: one.id)]
    maps = [one for one in maps if one.points and one.keyframes]
    if not maps:
        raise ValueError("the atlas is empty: it has no map with keyframes and landmarks")
    keyframes = [keyframe for one in maps for keyframe in one.keyframes]
    starts = np.cumsum([0, *(len(k.points) for k in keyframes)])
    labels = np.full(starts[-1], -1, np.int64)
    ids: list[NDArray[np.int64]] = []
    summaries = []
    last, first_keyframe = -1, 0
    for one in maps:
        own_ids = [p.id for p in one.points]
        # Ids of several maps may interleave.
        shift = max(0, last + 1 - min(own_ids))
        if len(set(own_ids)) < len(own_ids) or max(own_ids) + shift > _MAX_ID:
            raise ValueError(
                f"landmarks of map {one.id} share an id, or have one that is too large"
            )
        own = np.array(own_ids, np.int64)
        end = first_keyframe + len(one.keyframes)
        rows, owners = observations(one, starts[first_keyframe:end], own, dropped)
        labels[rows] = owners + shift
        ids.append(own + shift)
        last, first_keyframe = int(ids[-1].max()), end
        counts = {"keyframes": len(one.keyframes), "landmarks": len(own), "observations": len(rows)}
        summaries.append({"id": one.id, **counts, "ids": [int(ids[-1].min()), last]})
    landmark_ids = np.concatenate(ids)
    positions = np.array([p.position for one in maps for p in one.points], np.float64)
    order = np.argsort(landmark_ids)
    features = np.concatenate([part for k in keyframes for part in (k.keypoints, k.right)])
    bent = {k.lens for k in keyframes if (k.keypoints["xy"] != k.undistorted["xy"]).any()}
    names, numbers, poses, lengths, cameras = _images(keyframes, bent, atlas)
    source: dict[str, Any] = {
        "program": PROGRAM,
        "version": "unknown",
        "archive": f"Boost {atlas.archive_version}",
        "maps": summaries,
    }
    if dropped := +dropped:
        source["dropped"] = dict(dropped)
    if any(any(k.lens.distortion) and k.lens not in bent for k in keyframes):
        source["note"] = "cameras are those of rectified images: rectify query images alike"
    return Tracks(
        descriptor="orb",
        cameras=cameras,
        keyframe_names=names,
        keyframe_camera=numbers,
        cam_from_world=poses,
        offsets=np.cumsum([0, *lengths], dtype=np.int64),
        keypoints=features["xy"] + np.float32(0.5),
        sizes=features["size"].copy(),
        angles=np.where(features["angle"] >= 0, features["angle"] % np.float32(360), -1),
        responses=features["response"].copy(),
        octaves=features["octave"].copy(),
        descriptors=np.concatenate([k.descriptors for k in keyframes]),
        landmark_of_keypoint=labels,
        landmark_ids=landmark_ids[order],
        landmark_positions=positions[order],
        info={"source": source, "detector": _detector(keyframes)},
    )


def _without_bad(one: Map, dropped: Counter[str]) -> Map:
    """A map without what the program has given up, but not removed yet."""
    keyframes = sorted((k for k in one.keyframes if not k.bad), key=lambda k: k.id)
    points = [p for p in one.points if not p.bad and np.isfinite(p.position).all()]
    dropped["bad keyframes"] += len(one.keyframes) - len(keyframes)
    dropped["bad landmarks"] += len(one.points) - len(points)
    if bool(points) != bool(keyframes):
        dropped["keyframes of maps without landmarks"] += len(keyframes)
        dropped["landmarks of maps without keyframes"] += len(points)
    return Map(one.id, keyframes, points)


def observations(
    one: Map, starts: NDArray[np.int64], ids: NDArray[np.int64], dropped: Counter[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of keypoints that observe a landmark of a map, and its id.

    Landmarks and keypoints may disagree in a file. Of landmarks with the same keypoint the one
    counts that it names, else the first.
    """
    sides = [p.left for p in one.points] + [p.right for p in one.points]
    named = np.frombuffer(b"".join(sides), NAMED)
    lengths = np.array([len(side) for side in sides]) // NAMED.itemsize
    owner = np.repeat(np.concatenate([ids, ids]), lengths)
    seen = named["row"] >= 0
    named, owner = named[seen], owner[seen]
    numbers = np.array([k.id for k in one.keyframes], np.uint64)
    by_number = np.argsort(numbers)
    if (np.diff(numbers[by_number]) == 0).any():
        raise ValueError(f"two keyframes of map {one.id} have the same id")
    at = np.searchsorted(numbers, named["keyframe"], sorter=by_number)
    keyframe = by_number[np.minimum(at, len(numbers) - 1)]
    present = numbers[keyframe] == named["keyframe"]
    dropped["observations of keyframes that are not in the file"] += int((~present).sum())
    keyframe, row, owner = keyframe[present], named["row"][present], owner[present]
    limits = np.array([len(k.points) for k in one.keyframes])
    if (row >= limits[keyframe]).any():
        raise ValueError(f"a landmark of map {one.id} names a keypoint that its keyframe lacks")
    rows = starts[keyframe] + row
    agrees = np.concatenate([k.points for k in one.keyframes])[rows - starts[0]] == owner
    order = np.lexsort((owner, ~agrees, rows))
    first = order[np.flatnonzero(np.diff(rows[order], prepend=-1))]
    dropped["observations of a keypoint of another landmark"] += len(rows) - len(first)
    return rows[first], owner[first]


def _images(
    keyframes: list[Keyframe], bent: set[Lens], atlas: Atlas
) -> tuple[list[str], NDArray[np.int32], NDArray[np.float64], list[int], dict[int, Camera]]:
    """Names, camera ids, poses and numbers of keypoints of all images, and the cameras by id.

    Keypoints of `bent` lenses are distorted. Images that the program has rectified keep the
    coefficients of those that it was given, and are not.
    """
    lenses = {lens: _camera(lens, lens in bent, atlas) for lens in {k.lens for k in keyframes}}
    found: dict[Camera, int] = {}
    taken: Counter[str] = Counter()
    names, numbers, poses, lengths = [], [], [], []
    for k in keyframes:
        name = f"{k.time:.6f}"
        taken[name] += 1
        name += f" ({taken[name]})" if taken[name] > 1 else ""
        sides = [("", lenses[k.lens], k.cam_from_world, len(k.keypoints))]
        if len(k.right):
            second = _camera(k.lens._replace(id=k.second_camera), False, atlas)
            sides.append((" right", second, _right_pose(k), len(k.right)))
        for side, camera, pose, length in sides:
            names.append(name + side)
            numbers.append(found.setdefault(camera, len(found) + 1))
            poses.append(pose)
            lengths.append(length)
    cameras = {number: camera for camera, number in found.items()}
    return names, np.array(numbers, np.int32), np.array(poses), lengths, cameras


def _right_pose(keyframe: Keyframe) -> NDArray[np.float64]:
    rotation, translation = np.split(keyframe.left_from_right, [3], axis=1)
    left = keyframe.cam_from_world
    return rotation.T @ np.hstack([left[:, :3], left[:, 3:] - translation])


def _camera(lens: Lens, bent: bool, atlas: Atlas) -> Camera:
    """The camera of the raw images, to which keypoints belong."""
    left, top, right, bottom = lens.bounds
    if not (0 < right - left < _MAX_SIDE and 0 < bottom - top < _MAX_SIDE):
        raise ValueError(f"images of {right - left} x {bottom - top} pixels are absurd")
    if lens.id not in atlas.cameras:
        raise ValueError(f"a keyframe names camera {lens.id}, which is missing")
    fisheye, params = atlas.cameras[lens.id]
    params = _decimal(params)
    size = right - left, bottom - top
    if fisheye:
        return Camera.from_opencv(*size, params[:4], params[4:], fisheye=True)
    pinhole = _decimal((*lens.focal, *lens.center))
    if bent:
        return Camera.from_opencv(*_raw_size(lens), pinhole, _decimal(lens.distortion))
    return Camera.from_opencv(*size, pinhole)


def _decimal(numbers: Sequence[float]) -> tuple[float, ...]:
    """The shortest decimals that are these float32 numbers, as calibrations have them."""
    return tuple(float(str(np.float32(number))) for number in numbers)


def _raw_size(lens: Lens) -> tuple[int, int]:
    """Size of the images whose undistorted bounds, rounded towards zero, a file has.

    Of several that fit it is the one with sides that are multiples of 8, if there is one.
    """
    bounds = np.array(lens.bounds)
    size = 2 * np.array(lens.center)
    for _ in range(20):
        size += np.clip((bounds + 0.5 * np.sign(bounds) - _bounds(lens, size))[2:], -50, 50)
    size = np.clip(np.rint(size), 1, _MAX_SIDE)
    near = [size + np.array(step) for step in product(range(-3, 4), repeat=2)]
    fitting = [s for s in near if np.array_equal(np.trunc(_bounds(lens, s)), bounds)]
    best = min(fitting or [size], key=lambda s: (np.count_nonzero(s % 8), *np.abs(s - size)))
    return int(best[0]), int(best[1])


def _bounds(lens: Lens, size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Left, top, right and bottom of undistorted images, as the program computes them.

    cv::undistortPoints repeats a step five times, which does not converge in strong distortion.
    """
    focal, center = np.array(lens.focal), np.array(lens.center)
    k1, k2, p1, p2, k3 = (*lens.distortion, 0.0)[:5]
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - center) / focal
    x, y = corners.T
    for _ in range(5):
        square = x * x + y * y
        scale = 1 / (1 + ((k3 * square + k2) * square + k1) * square)
        dx = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        dy = p1 * (square + 2 * y * y) + 2 * p2 * x * y
        x, y = (corners[:, 0] - dx) * scale, (corners[:, 1] - dy) * scale
    x, y = x * focal[0] + center[0], y * focal[1] + center[1]
    return np.array([min(x[0], x[2]), min(y[0], y[1]), max(x[1], x[3]), max(y[2], y[3])])


def _detector(keyframes: list[Keyframe]) -> dict[str, Any]:
    kinds = Counter((k.levels, *_decimal([k.scale_factor])) for k in keyframes)
    levels, scale_factor = kinds.most_common(1)[0][0]
    return {"name": "ORB-SLAM", "levels": levels, "scale_factor": scale_factor}
