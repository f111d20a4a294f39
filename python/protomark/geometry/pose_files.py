"""Reads and writes poses by image: COLMAP's images.txt and TUM trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.pose import (
    camera_centers,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

# An image and a pose belong together if their times differ by less than this share of the median
# step between poses.
_TIME_SHARE = 0.5


class PoseSet:
    """Poses by image name, or by time.

    Attributes:
        by_name: name -> (3, 4) cam_from_world.
        times: (n,) float64, ascending; empty where poses go by name.
        poses: (n, 3, 4) float64, of these times.
    """

    def __init__(
        self,
        by_name: Mapping[str, NDArray[np.float64]],
        times: NDArray[np.float64] | None = None,
        poses: NDArray[np.float64] | None = None,
    ) -> None:
        self.by_name = by_name
        self.times = np.zeros(0) if times is None else times
        self.poses = np.zeros((0, 3, 4)) if poses is None else poses
        steps = np.diff(self.times)
        self._limit = _TIME_SHARE * float(np.median(steps)) if len(steps) else 0.0

    def __len__(self) -> int:
        return len(self.by_name) + len(self.times)

    @property
    def example(self) -> str:
        """The image name or time of the first pose, for error messages."""
        return next(iter(self.by_name), None) or f"time {self.times[0]:g}"

    def find(self, name: str, time: float | None = None) -> NDArray[np.float64] | None:
        """The pose of an image, None if the set has none for it.

        Args:
            name: the image's name; one without folders is looked up, too.
            time: the image's time in seconds; None: read it from a name such as
                1305031102.175304.png.
        """
        path = Path(name)
        if not len(self.times):
            return self.by_name.get(name, self.by_name.get(path.name))
        try:
            time = float(path.stem) if time is None else time
        except ValueError:
            return None
        at = int(np.argmin(np.abs(self.times - time)))
        return self.poses[at] if abs(self.times[at] - time) <= self._limit else None


def read_poses(path: Path) -> PoseSet:
    """Read a COLMAP model (folder), a COLMAP images.txt, or a TUM trajectory.

    A TUM trajectory has one line per pose: time, position and quaternion x y z w of the camera in
    the world.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        ValueError: the file is none of these, or a pose in it is broken.
    """
    if path.is_dir():
        from protomark.geometry.colmap import find_model, read_model

        model = read_model(find_model(path))
        return PoseSet(dict(zip(model.names, model.cam_from_world, strict=True)))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder of poses")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ValueError(
            f"{path}: not a text file; give a COLMAP images.txt, a folder with a model, or a TUM "
            "trajectory"
        ) from None
    rows = [(i, line.split()) for i, line in enumerate(lines, 1) if line[:1] != "#"]
    filled = [row for row in rows if row[1]]
    if not filled:
        raise ValueError(f"{path}: no poses in this file")
    if all(len(words) == 8 for _, words in filled):
        return _read_tum(path, filled)
    return _read_images_txt(path, rows)


def _read_tum(path: Path, rows: list[tuple[int, list[str]]]) -> PoseSet:
    times, poses = [], []
    for number, words in rows:
        values = _numbers(path, number, words)
        times.append(values[0])
        rotation = _rotation(path, number, values[[7, 4, 5, 6]]).T
        poses.append(np.column_stack([rotation, -rotation @ values[1:4]]))
    order = np.argsort(times, kind="stable")
    return PoseSet({}, np.array(times)[order], np.array(poses)[order])


def _read_images_txt(path: Path, rows: list[tuple[int, list[str]]]) -> PoseSet:
    # Every image has a second line for its points, which may be empty.
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
        rotation = _rotation(path, number, values[:4])
        by_name[" ".join(words[9:])] = np.column_stack([rotation, values[4:7]])
    if not by_name:
        raise ValueError(f"{path}: no poses in this file")
    return PoseSet(by_name)


def _numbers(path: Path, line: int, words: list[str]) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{path}, line {line}: not a pose, a word in it is not a number") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}, line {line}: a number is not finite")
    return values


def _rotation(path: Path, line: int, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        return rotation_from_quaternion(quaternion)
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}") from None


def images_txt(poses: Mapping[str, NDArray[np.float64]], camera_ids: Mapping[str, int]) -> str:
    """The text of an images.txt with these poses (3, 4) by image name, without keypoints."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and an empty line for the points"]
    for i, (name, pose) in enumerate(poses.items(), 1):
        numbers = " ".join(
            f"{x:.12g}" for x in (*quaternion_from_rotation(pose[:, :3]), *pose[:, 3])
        )
        lines += [f"{i} {numbers} {camera_ids[name]} {name}", ""]
    return "\n".join(lines) + "\n"


def tum_trajectory(times: NDArray[np.float64], cam_from_world: NDArray[np.float64]) -> str:
    """The text of a TUM trajectory: time tx ty tz qx qy qz qw of the camera in the world.

    Args:
        times: (n,) seconds, in the order to write.
        cam_from_world: (n, 3, 4) poses.
    """
    lines = ["# time tx ty tz qx qy qz qw (camera in world)"]
    for time, pose in zip(times, cam_from_world, strict=True):
        w, x, y, z = quaternion_from_rotation(pose[:, :3].T)
        numbers = [f"{v + 0.0:.9g}" for v in (*camera_centers(pose), x, y, z, w)]
        lines.append(" ".join([f"{time:.6f}", *numbers]))
    return "\n".join(lines) + "\n"
