"""Reads the bytes of ORB-SLAM3's atlases (.osa), to the last."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.pose import rotation_from_quaternion
from protomark.tracks.importers.boost import Archive

DESCRIPTOR_BYTES = 32
# Classes that the program registers before it writes.
_CLASSES = {"Atlas": 0, "Pinhole": 1, "KannalaBrandt8": 2}
_KEYPOINT = np.dtype(
    [
        *((name, "<f4") for name in ("angle", "response", "size")),
        ("xy", "<f4", 2),
        *((name, "<i4") for name in ("class_id", "octave")),
    ]
)
# How a point names a keypoint: its keyframe's id and its row there, -1 for none.
NAMED = np.dtype([("keyframe", "<u8"), ("row", "<i4")])
_FLOATS = ("angle", "response", "size", "xy")
# By cv::Mat's number of a type.
_MAT_DTYPES: dict[int, np.dtype[Any]] = {0: np.dtype("u1"), 5: np.dtype("<f4"), 6: np.dtype("<f8")}
_MAX_PIXEL = 1e6
# Bytes that each takes at least, which bounds how many there may be.
_MIN_MAP, _MIN_CAMERA, _MIN_KEYFRAME, _MIN_POINT, _MEASUREMENT = 60, 30, 2500, 115, 28

_MAP_HEAD = struct.Struct("<QQQi")
_KEYFRAME_HEAD = struct.Struct("<QQd2i3f9f")
_SCALES = struct.Struct("<i2f")
_COUNT = struct.Struct("<i")
_MATRIX = struct.Struct("<3iB")
_PARENT = struct.Struct("<Bq")
_POINT_HEAD = struct.Struct("<Qqqi3f3f")
_POINT_TAIL = struct.Struct("<QBq2f")
# Inertial measurements between keyframes, integrated: two 15x15 matrices and 97 numbers more. Then
# poses, covariances and a flag of the sensor's calibration.
_INTEGRATED = 4 * (2 * 225 + 97)
_CALIBRATION = 4 * (7 + 7 + 6 + 6) + 1
_INERTIAL_TAIL = 8 + 8 + 1 + 4 * 6 + 1


class Lens(NamedTuple):
    """What a keyframe tells of its camera."""

    id: int
    focal: tuple[float, float]
    center: tuple[float, float]
    distortion: tuple[float, ...]
    bounds: tuple[int, int, int, int]  # of undistorted pixels: left, top, right, bottom


@dataclass
class Keyframe:
    """A keyframe: one image, or two of a pair of fisheye cameras."""

    id: int
    time: float  # seconds
    bad: bool
    lens: Lens
    second_camera: int  # id of the right camera, -1 for none
    keypoints: NDArray[Any]  # (n,) structures
    undistorted: NDArray[Any]  # (n,) structures
    right: NDArray[Any]  # (r,) structures: keypoints of the right image
    descriptors: NDArray[np.uint8]  # (n + r, 32)
    points: NDArray[np.int64]  # (n + r,) id of the point that a keypoint observes, -1: none
    cam_from_world: NDArray[np.float64]  # (3, 4)
    left_from_right: NDArray[np.float64]  # (3, 4)
    levels: int
    scale_factor: float


class Point(NamedTuple):
    """A map point, and the keypoints that observe it by keyframe id."""

    id: int
    position: tuple[float, float, float]
    bad: bool
    left: memoryview  # bytes of `NAMED`: keypoints of left, or only, images
    right: memoryview


@dataclass
class Map:
    """A map, which has a world of its own."""

    id: int
    keyframes: list[Keyframe] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)


class CameraModel(NamedTuple):
    """A camera without the size of its images."""

    fisheye: bool
    params: tuple[float, ...]


@dataclass
class Atlas:
    """What a file holds, as far as a map needs it."""

    archive_version: int
    maps: list[Map]
    cameras: dict[int, CameraModel]


class AtlasReader(Archive):
    """Reads an atlas from the bytes of a file."""

    remedy = (
        "the file is cut off or broken, or a fork of ORB-SLAM3 that stores other fields wrote it; "
        "atlases of ORB-SLAM3 1.0 can be read"
    )

    def atlas(self) -> Atlas:
        """All maps.

        Raises:
            ValueError: the bytes are no atlas, or end early or late.
        """
        self.where = "header"
        self.text(), self.text()  # the vocabulary's name and digest
        self.expect(self.pointer("Atlas", _CLASSES), "there is no atlas")
        maps = [self._map() for _ in self.items("Map*", _MIN_MAP)]
        self.where = "cameras"
        cameras = dict(self._camera() for _ in self.items("GeometricCamera*", _MIN_CAMERA))
        self.skip(6 * 8)  # next ids
        self.where = "end"
        self.expect(not len(self), f"{len(self):,} bytes too many")
        return Atlas(self.version, maps, cameras)

    def _map(self) -> Map:
        self.where = "maps"
        self.object("Map", _CLASSES)
        out = Map(self.unpack(_MAP_HEAD)[0])
        keyframes = self.items("KeyFrame*", _MIN_KEYFRAME)
        for i in keyframes:
            self.where = f"keyframe {i + 1:,} of {len(keyframes):,} of map {out.id}"
            self.object("KeyFrame", _CLASSES)
            out.keyframes.append(self._keyframe())
        points = self.items("MapPoint*", _MIN_POINT)
        for i in points:
            self.where = f"point {i + 1:,} of {len(points):,} of map {out.id}"
            self.object("MapPoint", _CLASSES)
            out.points.append(self._point())
        self.where = f"end of map {out.id}"
        self.numbers("<u8")  # first keyframes
        self.skip(2 * 8)
        self.flags(4)
        return out

    def _camera(self) -> tuple[int, CameraModel]:
        fisheye = bytes(self.data[self.offset : self.offset + 2]) == b"\2\0"
        self.object("KannalaBrandt8" if fisheye else "Pinhole", _CLASSES)
        self.begin("GeometricCamera")
        number, kind = self.u32(), self.u32()
        params = tuple(self.numbers("<f4").tolist())
        self.skip(4 * fisheye)  # precision
        self.expect(
            kind == fisheye and len(params) == (8 if fisheye else 4),
            f"a camera of type {kind} with {len(params)} parameters is unknown",
        )
        return number, CameraModel(fisheye, params)

    def _keyframe(self) -> Keyframe:
        number, _, time, *head = self.unpack(_KEYFRAME_HEAD)
        fx, fy, _, _, cx, cy = head[5:11]
        distortion = tuple(self._matrix().ravel().tolist())
        count = self._count()
        keypoints, undistorted = self._keypoints(), self._keypoints()
        self._per_keypoint("<f4"), self._per_keypoint("<f4")  # x in the right image, depth
        descriptors = self._descriptors()
        self.begin("BowVector")
        self.pairs("I", "d")
        self.begin("FeatureVector")
        for _ in self.items("map of node to keypoints", 12):
            self.begin("pair of node to keypoints")
            self.skip(4)
            self._keypoints_of_node()
        self.skip(7 * 4)  # pose before a loop was closed
        levels, scale_factor, _ = self.unpack(_SCALES)
        for _ in range(3):
            self.expect(len(self.numbers("<f4")) == levels, f"a list is not of {levels} levels")
        left, top, right_end, bottom = self.array("<i4", 4).tolist()
        self.skip(9 * 4)  # camera matrix
        pose = self._pose()
        points = self._per_keypoint("<i8")
        self._grid()
        self.pairs("Q", "i")  # covisible keyframes
        self.unpack(_PARENT)
        for _ in range(3):
            self.numbers("<u8")  # children, loop edges, merge edges
        *_, bad = self.flags(3)
        self.skip(8)
        camera, second_camera = self.array("<i4", 2).tolist()
        self.numbers("<i4"), self.numbers("<i4")  # matches between left and right
        lefts, rights = self.array("<i4", 2).tolist()
        left_from_right = self._pose()
        right = self._keypoints()
        if lefts < 0:  # of a rectified pair, only x in the right image is used
            right = right[:0]
        self._grid()
        self._inertial()
        rows = len(keypoints) + len(right)
        fits = rows == count == len(points) and len(keypoints) == len(undistorted)
        fits = fits and (lefts, rights) in ((-1, -1), (len(keypoints), len(right)))
        fits = fits and descriptors.shape == (rows, DESCRIPTOR_BYTES if rows else 0)
        fits = fits and descriptors.dtype == np.uint8
        self.expect(
            fits,
            f"{rows:,} keypoints, {len(points):,} labels and {descriptors.dtype} descriptors of "
            f"shape {descriptors.shape} do not fit together",
        )
        self.expect(
            np.isfinite([time, fx, fy, cx, cy, *distortion]).all() and 1 < scale_factor < 10,
            "time, camera or scale are absurd",
        )
        lens = Lens(camera, (fx, fy), (cx, cy), distortion, (left, top, right_end, bottom))
        keyframe = (number, time, bool(bad), lens, second_camera, keypoints, undistorted, right)
        poses = (pose, left_from_right, levels, scale_factor)
        return Keyframe(*keyframe, descriptors.reshape(rows, DESCRIPTOR_BYTES), points, *poses)

    def _point(self) -> Point:
        head = self.unpack(_POINT_HEAD)
        left, right = self._named(), self._named()
        self._descriptors()  # one of its keypoints'
        _, bad, *_ = self.unpack(_POINT_TAIL)
        self.expect(bad <= 1, "a truth value is neither 0 nor 1")
        return Point(head[0], head[4:7], bool(bad), left, right)

    # What a writer of atlases changes is read by methods of its own.

    def _count(self) -> int:
        """The number of a keyframe's keypoints."""
        return self.i32()

    def _per_keypoint(self, dtype: str) -> NDArray[Any]:
        """A number of each keypoint."""
        return self.numbers(dtype)

    def _descriptors(self) -> NDArray[Any]:
        return self._matrix()

    def _keypoints_of_node(self) -> NDArray[np.uint32]:
        """The rows of keypoints that a node of the vocabulary has."""
        return self.numbers("<u4")

    def _named(self) -> memoryview:
        """The keypoints that a point names, bytes of `NAMED`."""
        return self.pairs("Q", "i")

    def _matrix(self) -> NDArray[Any]:
        """A cv::Mat of one channel (rows, columns)."""
        return self.array(*self._matrix_shape())

    def _matrix_shape(self) -> tuple[np.dtype[Any], int, int]:
        columns, rows, kind, continuous = self.unpack(_MATRIX)
        fits = kind in _MAT_DTYPES and min(columns, rows) >= 0 and continuous <= 1
        self.expect(fits, f"a matrix of type {kind} with {rows} x {columns} numbers is unknown")
        return _MAT_DTYPES[kind], rows, columns

    def _keypoints(self) -> NDArray[Any]:
        keypoints = self.array(_KEYPOINT, self.count(_KEYPOINT.itemsize, _COUNT))
        # False for NaN, too.
        fits = all((np.abs(keypoints[name]) < _MAX_PIXEL).all() for name in _FLOATS)
        self.expect(fits, "keypoints lie outside any image")
        return keypoints

    def _pose(self) -> NDArray[np.float64]:
        numbers = self.array("<f4", 7).astype(np.float64)
        try:
            rotation = rotation_from_quaternion(numbers[:4])
        except ValueError as error:
            self.fail(str(error))
        self.expect(np.isfinite(numbers).all(), "the pose is not finite")
        return np.column_stack([rotation, numbers[4:]])

    def _grid(self) -> None:
        """Which keypoints lie in each cell, of all columns and rows."""
        for _ in self.items("grid", 12):
            self.skip_vectors(len(self.items("column of a grid", 8)))

    def _inertial(self) -> None:
        self.begin("bias")
        self.skip(6 * 4)
        self.begin("integrated measurements")
        self.skip(_INTEGRATED)
        measurements = len(self.items("measurements", _MEASUREMENT))
        if measurements:
            self.begin("measurement")
        self.skip(measurements * _MEASUREMENT)
        self.begin("calibration")
        self.skip(_CALIBRATION + _INERTIAL_TAIL)
