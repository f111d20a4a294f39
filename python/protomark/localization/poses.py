"""Reading and writing poses by image: COLMAP's images.txt and TUM trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# A time is that of a pose if they differ by less than this share of the typical step.
_TIME_SHARE = 0.5


class GivenPoses:
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
        """What the first pose is of."""
        return next(iter(self.by_name), None) or f"time {self.times[0]:g}"

    def of(self, name: str, time: float | None = None) -> NDArray[np.float64] | None:
        """The pose of an image, None where none is given.

        Args:
            name: its name; one without folders serves, too.
            time: its time in seconds; None: its name is one, such as 1305031102.175304.png.
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


def read_poses(path: Path) -> GivenPoses:
    """Read a COLMAP model (folder), a COLMAP images.txt, or a TUM trajectory.

    A trajectory has a line a pose: time, position and quaternion x y z w of the camera in the
    world.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        ValueError: it is none of these, or a pose in it is broken.
    """
    if path.is_dir():
        from protomark.tracks.colmap import find_model, model_of, read_reconstruction

        folder = find_model(path)
        model = model_of(read_reconstruction(folder), folder)
        return GivenPoses(dict(zip(model.names, model.cam_from_world, strict=True)))
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
        return _tum(path, filled)
    return _colmap(path, rows)


def _tum(path: Path, rows: list[tuple[int, list[str]]]) -> GivenPoses:
    times, poses = [], []
    for number, words in rows:
        values = _numbers(path, number, words)
        times.append(values[0])
        rotation = _rotation_in(path, number, values[[7, 4, 5, 6]]).T
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
        rotation = _rotation_in(path, number, values[:4])
        by_name[" ".join(words[9:])] = np.column_stack([rotation, values[4:7]])
    if not by_name:
        raise ValueError(f"{path}: no poses in this file")
    return GivenPoses(by_name)


def _numbers(path: Path, line: int, words: list[str]) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{path}, line {line}: not a pose, a word is no number") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}, line {line}: a number is not finite")
    return values


def _rotation_in(path: Path, line: int, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        return rotation_of(quaternion)
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}") from None


def images_txt(poses: Mapping[str, NDArray[np.float64]], camera_ids: Mapping[str, int]) -> str:
    """COLMAP's images.txt with these poses (3, 4) by name, without keypoints."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and an empty line for the points"]
    for i, (name, pose) in enumerate(poses.items(), 1):
        numbers = " ".join(f"{x:.12g}" for x in (*quaternion_of(pose[:, :3]), *pose[:, 3]))
        lines += [f"{i} {numbers} {camera_ids[name]} {name}", ""]
    return "\n".join(lines) + "\n"


def rotation_of(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """w, x, y, z -> (3, 3)."""
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or abs(norm - 1) > 0.05:
        raise ValueError(f"quaternion {quaternion.tolist()} is not of length 1")
    w, *v = quaternion / norm
    x = np.array(v)
    cross = np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) -> w, x, y, z with w >= 0: the eigenvector of Bar-Itzhack (2000), well conditioned."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0, 0, 0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0, 0],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0],
            [
                r[1, 0] - r[0, 1],
                r[2, 0] + r[0, 2],
                r[2, 1] + r[1, 2],
                r[2, 2] - r[0, 0] - r[1, 1],
            ],
        ]
    )
    _, vectors = np.linalg.eigh(k)  # the lower triangle counts
    q = vectors[:, -1]
    return np.asarray(q if q[0] >= 0 else -q)
