"""Reads and writes kapture data sets (kapture_format.adoc of naver/kapture, versions 1.0 and 1.1).

Poses, cameras and pixels are COLMAP's. A keypoint has x, y and, if there are four numbers, scale
and orientation in radians, or six, an affine shape.
"""

from __future__ import annotations

import tarfile
from array import array
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.features.extractor import Features
from protomark.files import hash_files, natural_key, replacing_folder
from protomark.geometry.camera import Camera
from protomark.geometry.pose import compose, quaternion_from_rotation, rotation_from_quaternion
from protomark.tracks.file import Tracks
from protomark.tracks.importers.binary_descriptors import binary_descriptor, refusal
from protomark.tracks.importers.keyframes import Keyframe, checked_features, join, unexpected

PROGRAM = "kapture"
_HEADER = "# kapture format: 1.1\n"
_MAX_RIGS = 8  # rigs in rigs

Pose = NDArray[np.float64]


def recognizes(path: Path, head: bytes) -> bool:
    """Whether a folder is a kapture data set."""
    return (path / "sensors" / "sensors.txt").is_file()


def read(path: Path) -> Tracks:
    """Read a data set.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it has no binary descriptors, or it is broken.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of {PROGRAM}")
    with unexpected(path, "data set"):
        kind, keypoints, descriptors = _types(path)
        dropped: Counter[str] = Counter()
        cameras = _cameras(path)
        numbers = {name: i for i, name in enumerate(cameras, 1)}
        labels = _observations(path, keypoints.name)
        keyframes = []
        poses = _Poses(path)
        images = [*_rows(path / "sensors" / "records_camera.txt", 3)]
        for timestamp, sensor, image in sorted(images, key=lambda row: natural_key(row[2])):
            if not keypoints.has(image) or not descriptors.has(image):
                continue
            pose = poses.find(timestamp, sensor)
            if pose is None or sensor not in cameras:
                dropped["keyframes without pose or camera"] += 1
                continue
            with unexpected(path, f"image {image}"):
                rows, points = labels.get(image, (array("q"), array("q")))
                features = _features(keypoints.read(image), descriptors.read(image), kind)
                label = np.full(len(features), -1, np.int64)
                label[np.array(rows, np.int64)] = np.array(points, np.int64)
            keyframes.append(Keyframe(image, numbers[sensor], pose, features, label))
        positions = _positions(path)
    version = _version(path)
    digest = hash_files(
        (str(p.relative_to(path)), p)
        for p in sorted(path.glob("**/*"))
        if p.is_file() and "records_data" not in p.parts
    )
    source = {"program": PROGRAM, "version": version, "digest": digest, "dropped": dict(+dropped)}
    info = {"source": source, "detector": {"name": keypoints.label}}
    by_number = {number: cameras[name] for name, number in numbers.items()}
    return join(path, kind, by_number, keyframes, (np.arange(len(positions)), positions), info)


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Numbers and fields of the lines that are no comment; none of a file that is absent."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if line.strip() and line[0] != "#":
                yield number, [field.strip() for field in line.split(",")]


def _rows(path: Path, count: int) -> Iterator[list[str]]:
    for number, fields in _lines(path):
        if len(fields) < count:
            raise ValueError(f"{path}, line {number}: {count} fields should stand here")
        yield fields


def _version(path: Path) -> str:
    with (path / "sensors" / "sensors.txt").open(encoding="utf-8-sig", errors="replace") as file:
        name, _, version = file.readline().partition("format:")
    return version.strip()[:20] if "kapture" in name else "unknown"


class _Arrays:
    """The arrays of all images, of keypoints or descriptors of a type, in files or in a tar."""

    def __init__(self, folder: Path, what: str) -> None:
        self.folder, self.name, self.suffix = folder, folder.name, _SUFFIXES[what]
        fields = next(iter(_rows(folder / f"{what}.txt", 3)), None)
        if fields is None:
            raise ValueError(f"{folder / what}.txt is empty")
        self.label, dtype, size, *self.more = fields
        self.dtype = np.dtype(dtype).newbyteorder("<")
        self.size = int(size)
        if self.dtype.kind not in "fiu" or not 0 < self.size < 2**16:
            raise ValueError(f"{folder / what}.txt: {size} numbers of type {dtype[:20]}")
        self._archive = folder / f"{what}.tar"
        self._members: dict[str, tuple[int, int]] = {}  # where they begin, and bytes
        if self._archive.is_file():
            with tarfile.open(self._archive, "r:") as tar:
                found = {m.name.removeprefix("./"): (m.offset_data, m.size) for m in tar}
            end = self._archive.stat().st_size
            self._members = {k: m for k, m in found.items() if sum(m) <= end}

    def _name(self, image: str) -> str:
        parts = PurePosixPath(image)
        if parts.is_absolute() or ".." in parts.parts:
            raise ValueError(f"image {image[:80]!r} is not below the data set")
        return image + self.suffix

    def has(self, image: str) -> bool:
        """Whether there is an array of an image."""
        name = self._name(image)
        return name in self._members or (self.folder / name).is_file()

    def read(self, image: str) -> NDArray[Any]:
        """The array (n, size) of an image."""
        name = self._name(image)
        if name in self._members:
            begin, length = self._members[name]
            with self._archive.open("rb") as file:
                file.seek(begin)
                data = file.read(length)
        else:
            data = (self.folder / name).read_bytes()
        if len(data) % (self.size * self.dtype.itemsize):
            raise ValueError(f"{name} has {len(data)} bytes, not rows of {self.size} {self.dtype}")
        return np.frombuffer(data, self.dtype).reshape(-1, self.size)


_SUFFIXES = {"keypoints": ".kpt", "descriptors": ".desc"}


def _types(path: Path) -> tuple[str, _Arrays, _Arrays]:
    """The first binary descriptor, and its keypoints and descriptors."""
    found = path / "reconstruction" / "descriptors"
    refused = []
    # Until version 1.1 there was one type, without a folder of its own.
    for file in sorted([*found.glob("descriptors.txt"), *found.glob("*/descriptors.txt")]):
        descriptors = _Arrays(file.parent, "descriptors")
        kind = binary_descriptor(descriptors.label, str(descriptors.dtype), descriptors.size)
        if kind is None:
            refused.append(f"{descriptors.label} ({descriptors.size} {descriptors.dtype})")
            continue
        keypoints = path / "reconstruction" / "keypoints"
        if file.parent != found:
            keypoints /= descriptors.more[0] if descriptors.more else file.parent.name
        return kind, _Arrays(keypoints, "keypoints"), descriptors
    raise refusal(path, PROGRAM, refused)


def _features(keypoints: NDArray[Any], descriptors: NDArray[Any], kind: str) -> Features:
    k = keypoints.astype(np.float64)
    sizes, angles = np.ones(len(k)), None
    if k.shape[1] == 6:
        sizes = 2 * np.sqrt(np.abs(k[:, 2] * k[:, 5] - k[:, 3] * k[:, 4]))
        angles = np.degrees(np.arctan2(k[:, 4], k[:, 2])) % 360
    elif k.shape[1] > 2:
        sizes = 2 * k[:, 2]
        angles = np.degrees(k[:, 3]) % 360 if k.shape[1] == 4 else None
    rows = descriptors[:, : 61 if kind == "akaze" else None]
    return checked_features(k[:, :2], np.ascontiguousarray(rows), sizes, angles)


def _cameras(path: Path) -> dict[str, Camera]:
    cameras = {}
    for name, _, kind, *params in _rows(path / "sensors" / "sensors.txt", 3):
        if kind != "camera" or not params or params[0] == "UNKNOWN_CAMERA":
            continue
        with unexpected(path, f"sensor {name}"):
            width, height, *numbers = map(float, params[1:])
            cameras[name] = Camera(params[0], int(width), int(height), tuple(numbers))
            cameras[name].check()
    return cameras


class _Poses:
    """Poses of devices by time, and of sensors on rigs."""

    def __init__(self, path: Path) -> None:
        self.poses = {
            (row[0], row[1]): pose
            for row in _rows(path / "sensors" / "trajectories.txt", 9)
            if (pose := self._pose(path, row)) is not None
        }
        self.rigs: dict[str, list[tuple[str, Pose]]] = {}
        for row in _rows(path / "sensors" / "rigs.txt", 9):
            if (pose := self._pose(path, row)) is not None:
                self.rigs.setdefault(row[1], []).append((row[0], pose))

    @staticmethod
    def _pose(path: Path, row: list[str]) -> Pose | None:
        """The motion in a row, None if a part of it is unknown."""
        with unexpected(path, f"pose of {row[1]} at {row[0]}"):
            numbers = np.array([float(field or "nan") for field in row[2:9]])
            if not np.isfinite(numbers).all():
                return None
            return np.column_stack([rotation_from_quaternion(numbers[:4]), numbers[4:]])
        return None

    def find(self, timestamp: str, device: str, depth: int = 0) -> Pose | None:
        """cam_from_world (3, 4) of a device, or of the rig that it is on; None: unknown."""
        own = self.poses.get((timestamp, device))
        if own is not None or depth == _MAX_RIGS:
            return own
        for rig, sensor_from_rig in self.rigs.get(device, [])[:_MAX_RIGS]:
            rig_from_world = self.find(timestamp, rig, depth + 1)
            if rig_from_world is not None:
                return compose(sensor_from_rig, rig_from_world)
        return None


def _observations(path: Path, keypoints: str) -> dict[str, tuple[array[int], array[int]]]:
    """Rows of keypoints, and their points, by image."""
    out: dict[str, tuple[array[int], array[int]]] = {}
    typed = keypoints != "keypoints"
    file = path / "reconstruction" / "observations.txt"
    for number, fields in _lines(file):
        if typed and fields[1:2] != [keypoints]:
            continue
        seen = fields[1 + typed :]
        if len(seen) % 2:
            raise ValueError(f"{file}, line {number}: images and features are no pairs")
        with unexpected(file, f"line {number}"):
            point = int(fields[0])
            for image, feature in zip(seen[::2], map(int, seen[1::2]), strict=True):
                rows, points = out.setdefault(image, (array("q"), array("q")))
                rows.append(feature if feature >= 0 else 2**62)
                points.append(point)
    return out


def _positions(path: Path) -> NDArray[np.float64]:
    positions = array("d")
    for fields in _rows(path / "reconstruction" / "points3d.txt", 3):
        positions.extend(map(float, fields[:3]))
    return np.array(positions).reshape(-1, 3)


def write_kapture(tracks: Tracks, folder: Path) -> None:
    """Write tracks as a kapture data set without images, for a new folder.

    Landmark ids become rows of points3d.txt. Keypoints have x, y, scale (half the size) and, if any
    has an angle, orientation in radians; kapture has no place for octaves and responses.

    Raises:
        ValueError: the folder is not empty, or an image's name cannot be one of kapture's.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is not empty: name a new folder")
    for name in tracks.keyframe_names:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or set(name) & set(",\n\r\0"):
            raise ValueError(f"kapture has no images with a name such as {name[:80]!r}")
    oriented = bool((tracks.angles >= 0).any())
    kind = tracks.descriptor.upper()
    with replacing_folder(folder) as out:
        sensors, model = out / "sensors", out / "reconstruction"
        files = {
            sensors / "sensors.txt": [
                f"camera{number}, , camera, " + ", ".join(str(camera).split())
                for number, camera in tracks.cameras.items()
            ],
            sensors / "records_camera.txt": [
                f"{i}, camera{tracks.keyframe_camera[i]}, {name}"
                for i, name in enumerate(tracks.keyframe_names)
            ],
            sensors / "trajectories.txt": [
                f"{i}, camera{tracks.keyframe_camera[i]}, "
                + ", ".join(
                    map(
                        repr,
                        [*quaternion_from_rotation(pose[:, :3]).tolist(), *pose[:, 3].tolist()],
                    )
                )
                for i, pose in enumerate(tracks.cam_from_world)
            ],
            # kapture counts columns by this comment.
            model / "points3d.txt": ["# X, Y, Z"]
            + [", ".join(map(repr, xyz)) for xyz in tracks.landmark_positions.tolist()],
            model / "observations.txt": list(_observation_lines(tracks, kind)),
            model / "keypoints" / kind / "keypoints.txt": [f"{kind}, float32, {3 + oriented}"],
            model / "descriptors" / kind / "descriptors.txt": [
                f"{kind}, {tracks.descriptors.dtype}, {tracks.descriptors.shape[1]}, {kind}, "
                + ("Hamming" if tracks.input == "bits" else "L2")
            ],
        }
        for path, lines in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(_HEADER + "".join(f"{line}\n" for line in lines), encoding="utf-8")
        shapes: list[NDArray[Any]] = [tracks.keypoints, tracks.sizes / 2]
        if oriented:
            shapes.append(np.radians(np.maximum(tracks.angles, 0)))
        keypoints = np.column_stack(shapes).astype("<f4")
        for i, name in enumerate(tracks.keyframe_names):
            for what, values in (("keypoints", keypoints), ("descriptors", tracks.descriptors)):
                path = model / what / kind / (name + _SUFFIXES[what])
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(values[tracks.keypoints_of(i)].tobytes())


def _observation_lines(tracks: Tracks, kind: str) -> Iterator[str]:
    rows = tracks.observations
    rows = rows[np.argsort(tracks.landmark_of_keypoint[rows], kind="stable")]
    keyframes = tracks.keyframe_of_keypoint[rows]
    features = rows - tracks.offsets[keyframes]
    points = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint[rows])
    names = tracks.keyframe_names
    bounds = np.searchsorted(points, np.arange(len(tracks.landmark_ids) + 1))
    for point, (start, stop) in enumerate(
        zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
    ):
        seen = zip(keyframes[start:stop].tolist(), features[start:stop].tolist(), strict=True)
        if start < stop:
            yield ", ".join([f"{point}, {kind}", *(f"{names[k]}, {f}" for k, f in seen)])
