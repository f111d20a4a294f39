"""Reads and writes poses of images: COLMAP's images.txt and TUM trajectories."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.pose import (
    camera_centers,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

# Fewer images with a pose than this share deserve a warning.
_FEW = 0.5
# An image has the pose whose time differs by less than this share of the median step between poses.
_TIME_SHARE = 0.5


class PoseSet:
    """Poses by image name, or by time.

    Attributes:
        by_name: (3, 4) cam_from_world by image name.
        times: (n,) float64, ascending; empty if poses go by name.
        poses: (n, 3, 4) float64, the poses at these times.
        frame: the world's coordinates in words, "" if the file does not say.
    """

    def __init__(
        self,
        by_name: Mapping[str, NDArray[np.float64]],
        times: NDArray[np.float64] | None = None,
        poses: NDArray[np.float64] | None = None,
        frame: str = "",
    ) -> None:
        self.by_name, self.frame = by_name, frame
        self.times = np.zeros(0) if times is None else times
        self.poses = np.zeros((0, 3, 4)) if poses is None else poses
        steps = np.diff(self.times)
        self._limit = _TIME_SHARE * float(np.median(steps)) if len(steps) else 0.0

    def __len__(self) -> int:
        return len(self.by_name) + len(self.times)

    @property
    def example(self) -> str:
        """The image name or time of the first pose, for error messages."""
        return next(iter(self.by_name), None) or f"time {self.times[0]:.12g}"

    def find(self, name: str, time: float | None = None) -> NDArray[np.float64] | None:
        """The pose of an image, None if the set has none for it.

        Args:
            name: the image's name.
            time: the image's time in seconds; None: that of a name like 1305031102.175304.png, or,
                if all times of the poses are whole numbers, like 000012.png.
        """
        if not len(self.times):
            return self.by_name.get(name)
        stem = Path(name).stem
        try:
            if time is None and "." not in stem and (self.times % 1).any():
                return None
            time = float(stem) if time is None else time
        except ValueError:
            return None
        nearest = int(np.argmin(np.abs(self.times - time)))
        return self.poses[nearest] if abs(self.times[nearest] - time) <= self._limit else None


def match_names(images: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """For each image its name in another list: the same, or one with the same unique base name."""
    images, known = list(images), list(known)
    ours, theirs = (Counter(Path(name).name for name in names) for names in (images, known))
    full = {Path(name).name: name for name in known}
    same = set(known)
    out = {}
    for name in images:
        base = Path(name).name
        if name in same:
            out[name] = name
        elif ours[base] == theirs[base] == 1:
            out[name] = full[base]
    return out


def read_poses(path: Path) -> PoseSet:
    """Read a COLMAP model (folder), a COLMAP images.txt, or a TUM trajectory.

    A line of a TUM trajectory has the time, position and quaternion x y z w of a camera.

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
    rows = _rows(path)
    filled = [row for row in rows if row[1]]
    if filled and all(len(words) == 8 for _, words in filled):
        return _read_tum(path, filled)
    return _read_images_txt(path, rows)


def poses_of_images(
    path: Path, names: Sequence[str], times: Sequence[float | None] | None = None
) -> PoseSet:
    """Read the poses of these images, see `read_poses`, and warn if few of them have one.

    Args:
        path: a file or folder of poses.
        names: names of all images; one in another folder has the pose of its base name if that is
            unique among them and among the poses.
        times: times of all images in seconds, None for one without, see `PoseSet.find`.

    Raises:
        ValueError: none of the images has a pose; or see `read_poses`.
    """
    given = read_poses(path)
    by_name = {name: given.by_name[key] for name, key in match_names(names, given.by_name).items()}
    poses = PoseSet(by_name, given.times, given.poses)
    when: Sequence[float | None] = times or [None] * len(names)
    found = sum(poses.find(n, time) is not None for n, time in zip(names, when, strict=True))
    told = f"{found} of {len(names)} images have one of {len(given)} poses"
    if not found:
        image = names[0] if when[0] is None else f"time {when[0]:g}"
        raise ValueError(
            f"{path}: {told}: the poses start with {given.example}, the images with {image}; give "
            "both the same names, or times in seconds as in 1305031102.175304.png"
        )
    if found < _FEW * min(len(names), len(given)):
        warnings.warn(
            f"{path}: {told} (such as that of {given.example}): are these the poses of these "
            "images?",
            stacklevel=2,
        )
    return poses


def read_positions(path: Path) -> PoseSet:
    """Read camera positions: a text or CSV file of image name, x, y, z, or what `read_poses` reads.

    A header may name the columns; latitude, longitude and altitude become metres east, north and
    up of the first position. Poses of a file that has positions only are not rotated.

    Raises:
        FileNotFoundError, ValueError: see `read_poses`.
    """
    if path.is_dir() or not path.is_file():
        return read_poses(path)
    rows = table(path)
    if not rows or any(len(words) != 4 for _, words in rows):
        try:
            return read_poses(path)
        except ValueError as error:
            raise ValueError(
                f"{path} has neither lines of image name, x, y, z (or lat, lon, alt under a header "
                f"that names them), nor control points, nor poses ({error})"
            ) from None
    header = [word.lower() for word in rows[0][1]] if not is_number(rows[0][1][1]) else []
    rows = rows[1:] if header else rows
    if not rows:
        raise ValueError(f"{path} holds no positions: write a line of image name, x, y, z for each")
    at = np.array([numbers(path, number, words[1:]) for number, words in rows])
    columns = {name[:3]: i for i, name in enumerate(header[1:])}
    frame = ""
    if {"lat", "lon", "alt"} == set(columns):
        at, frame = east_north_up(*at[:, [columns[name] for name in ("lat", "lon", "alt")]].T)
    elif not header and _look_like_degrees(at):
        raise ValueError(
            f"{path}: positions look like degrees of latitude and longitude: write a header, "
            "image,lat,lon,alt (or image,x,y,z if they are not)"
        )
    names = [words[0] for _, words in rows]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{path}: image {twice} has two positions: leave one out")
    poses = {n: np.column_stack([np.eye(3), -p]) for n, p in zip(names, at, strict=True)}
    return PoseSet(poses, frame=frame)


def _look_like_degrees(at: NDArray[np.float64]) -> bool:
    """Whether positions (n, 3) are within some kilometres of a place, if they were degrees."""
    first, second = np.abs(at[:, :2]).max(axis=0)
    span = float(np.ptp(at[:, :2], axis=0).max())
    return bool(first <= 90 and second <= 180 and max(first, second) > 1 and 0 < span < 0.05)


def east_north_up(
    latitude: NDArray[np.float64], longitude: NDArray[np.float64], altitude: NDArray[np.float64]
) -> tuple[NDArray[np.float64], str]:
    """Metres (n, 3) east, north and up of the first of n positions (degrees, metres), in WGS 84.

    And a sentence that says so.
    """
    a, e2 = 6378137.0, 6.69437999014e-3
    lat, lon = np.radians(latitude), np.radians(longitude)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    x, y = ((n + altitude) * np.cos(lat) * f(lon) for f in (np.cos, np.sin))
    earth = np.column_stack([x, y, (n * (1 - e2) + altitude) * np.sin(lat)])
    (s, c), (sl, cl) = ((np.sin(v[0]), np.cos(v[0])) for v in (lat, lon))
    axes = np.array([[-sl, cl, 0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    frame = (
        f"metres east, north and up of latitude {latitude[0]:.9f}, longitude {longitude[0]:.9f}, "
        f"altitude {altitude[0]:.3f} (WGS 84)"
    )
    return np.asarray((earth - earth[0]) @ axes.T), frame


def table(path: Path) -> list[tuple[int, list[str]]]:
    """Numbers and words of the lines of a text or CSV file that are neither empty nor a comment."""
    rows = [(number, ",".join(words).split(",")) for number, words in _rows(path)]
    cells = [(number, [word for word in words if word]) for number, words in rows]
    return [(number, words) for number, words in cells if words]


def is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Numbers and words of the lines that are no comment."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(
            f"{path} is not a text file: give a COLMAP images.txt, a folder with a model, or a TUM "
            "trajectory"
        ) from None
    return [(i, line.split()) for i, line in enumerate(lines, 1) if line[:1] != "#"]


def _read_tum(path: Path, rows: list[tuple[int, list[str]]]) -> PoseSet:
    times, poses = [], []
    for number, words in rows:
        values = numbers(path, number, words)
        times.append(values[0])
        rotation = _rotation(path, number, values[[7, 4, 5, 6]]).T
        poses.append(np.column_stack([rotation, -rotation @ values[1:4]]))
    order = np.argsort(times, kind="stable")
    return PoseSet({}, np.array(times)[order], np.array(poses)[order])


def _read_images_txt(path: Path, rows: list[tuple[int, list[str]]]) -> PoseSet:
    by_name = {}
    for number, words in _image_rows(path, rows):
        if len(words) < 10:
            raise ValueError(
                f"{path}, line {number}: write a line of COLMAP's images.txt or of a TUM "
                "trajectory (time tx ty tz qx qy qz qw)"
            )
        values = numbers(path, number, words[1:8])
        rotation = _rotation(path, number, values[:4])
        by_name[" ".join(words[9:])] = np.column_stack([rotation, values[4:7]])
    if not by_name:
        raise ValueError(f"{path} holds no poses: give a COLMAP images.txt or a TUM trajectory")
    return PoseSet(by_name)


def check_images_txt(path: Path) -> None:
    """Raise ValueError if an image of an images.txt lacks the line for its points."""
    for _ in _image_rows(path, _rows(path)):
        pass


def _image_rows(path: Path, rows: list[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """The first of the two lines per image; the second has points, x y id each, or none."""
    left = iter(rows)
    for row in left:
        if not row[1]:
            continue
        yield row
        number, points = next(left, (0, []))
        if len(points) >= 10 and (len(points) % 3 or not points[-1].lstrip("-").isdigit()):
            raise ValueError(
                f"{path}, line {number}: the line for the points of the image above is missing: "
                "each image of an images.txt has two lines, of which the second may be empty"
            )


def numbers(path: Path, line: int, words: list[str]) -> NDArray[np.float64]:
    """The finite numbers that words of a line are; ValueError if one is none."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{path}, line {line}: a word is not a number") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}, line {line}: a number is not finite")
    return values


def _rotation(path: Path, line: int, quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        return rotation_from_quaternion(quaternion)
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}") from None


def images_txt(poses: Mapping[str, NDArray[np.float64]], camera_ids: Mapping[str, int]) -> str:
    """The text of an images.txt with poses (3, 4) by image name, and without keypoints."""
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
        numbers = [f"{v + 0.0:.12g}" for v in (*camera_centers(pose), x, y, z, w)]
        lines.append(" ".join([f"{time:.6f}", *numbers]))
    return "\n".join(lines) + "\n"


def image_times(names: Sequence[str]) -> tuple[list[float], bool]:
    """Times of images by their names, and whether these are seconds.

    They are seconds if all names are ascending numbers like 1305031102.175304.png, the numbers if
    they are whole, else indices.
    """
    stems = [Path(name).stem for name in names]
    seconds = all("." in stem for stem in stems)
    if seconds or all(stem.isdecimal() for stem in stems):
        with suppress(ValueError):
            times = [float(stem) for stem in stems]
            if np.isfinite(times).all() and (np.diff(times) > 0).all():
                return times, seconds
    return [float(i) for i in range(len(names))], False
