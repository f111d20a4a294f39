"""Poses that come with the images: a COLMAP model or images.txt, or a TUM trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protomark.mapping.structure import Array
from protomark.tracks.colmap import find_model, read_model

# A time is that of a pose if they differ by less than this share of the typical step.
_TIME_SHARE = 0.5


class GivenPoses:
    """Poses by image name, or by time.

    Attributes:
        by_name: name -> (3, 4) cam_from_world.
        times: (n,) float64, ascending; empty where poses go by name.
        poses: (n, 3, 4) float64, of these times.
    """

    def __init__(self, by_name: dict[str, Array], times: Array, poses: Array) -> None:
        self.by_name, self.times, self.poses = by_name, times, poses
        steps = np.diff(times)
        self._limit = _TIME_SHARE * float(np.median(steps)) if len(steps) else 0.0

    def of(self, name: str, time: float) -> Array | None:
        """The pose of a frame, None where none is given."""
        if not len(self.times):
            return self.by_name.get(name)
        at = int(np.argmin(np.abs(self.times - time)))
        return self.poses[at] if abs(self.times[at] - time) <= self._limit else None


def read_poses(path: Path) -> GivenPoses:
    """Read a COLMAP model (folder), a COLMAP images.txt, or a TUM trajectory (text).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of these, or a pose in it is broken.
    """
    if path.is_dir():
        model = read_model(find_model(path))
        poses = dict(zip(model.names, model.cam_from_world, strict=True))
        return GivenPoses(poses, np.zeros(0), np.zeros((0, 3, 4)))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder of poses")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; --poses takes images.txt or TUM") from None
    rows = [(i, line.split()) for i, line in enumerate(lines, 1) if line[:1] != "#"]
    filled = [words for _, words in rows if words]
    if filled and all(len(words) == 8 for words in filled):
        return _tum(path, [(i, words) for i, words in rows if words])
    return _colmap(path, rows)


def _tum(path: Path, rows: list[tuple[int, list[str]]]) -> GivenPoses:
    times, poses = [], []
    for number, words in rows:
        values = _numbers(path, number, words)
        times.append(values[0])
        rotation = rotation_of(values[[7, 4, 5, 6]], path, number).T
        poses.append(np.column_stack([rotation, -rotation @ values[1:4]]))
    order = np.argsort(times, kind="stable")
    return GivenPoses({}, np.array(times)[order], np.array(poses)[order])


def _colmap(path: Path, rows: list[tuple[int, list[str]]]) -> GivenPoses:
    # Lines of images and of their points take turns, also where an image has no points.
    by_name = {}
    for number, words in rows[::2]:
        if not words:
            continue
        if len(words) < 10:
            raise ValueError(
                f"{path}, line {number}: neither a line of COLMAP's images.txt nor of a TUM "
                "trajectory (time tx ty tz qx qy qz qw)"
            )
        values = _numbers(path, number, words[1:8])
        rotation = rotation_of(values[:4], path, number)
        by_name[" ".join(words[9:])] = np.column_stack([rotation, values[4:7]])
    if not by_name:
        raise ValueError(f"{path}: no poses in this file")
    return GivenPoses(by_name, np.zeros(0), np.zeros((0, 3, 4)))


def _numbers(path: Path, line: int, words: list[str]) -> Array:
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{path}, line {line}: not a pose, a word is no number") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}, line {line}: a number is not finite")
    return values


def rotation_of(quaternion: Array, path: Path, line: int) -> Array:
    """(3, 3) from w, x, y, z of any length above 0."""
    length = np.linalg.norm(quaternion)
    if length < 1e-6:
        raise ValueError(f"{path}, line {line}: the rotation (a quaternion) is zero")
    w, x, y, z = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
