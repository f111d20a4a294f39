"""Reads the frames of a folder of images, a video or a ROS bag."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from protomark.features.bag import bag_camera, bag_frames, camera_of_size, image_topic, is_bag
from protomark.features.bag_poses import bag_poses
from protomark.features.images import IMAGE_SUFFIXES, file_identity, image_names, read_gray
from protomark.features.video import Decode, check_video, video_frames
from protomark.geometry.camera import DEFAULT_FOCAL_RATIO, Camera
from protomark.geometry.camera_files import CameraSet, camera_from_exif
from protomark.geometry.pose_files import PoseSet, image_times, poses_of_images
from protomark.mapping.frame import InputImage
from protomark.mapping.prediction import MAX_STEP
from protomark.mapping.structure import Structure
from protomark.tracks.importers import check_own

# Number of a video's frames that are held in memory to read it backward.
_CHUNK = 64
_GUESSED_MODEL = "SIMPLE_RADIAL"
# Of so many images, spread over a folder, most have the size of the map's images.
_SIZE_SAMPLES = 15
# Cameras whose parameters differ by this share of the focal length count as one.
_SAME_CAMERA = 0.01
# A fisheye's image circle leaves out squares of this part of the longer side in each corner, where
# no pixel is brighter than that.
_CORNER, _BLACK = 16, 6
# Origins of a focal length.
GIVEN, EXIF, GUESS = "given", "from EXIF data", "a guess"


class FrameSource(ABC):
    """Frames in the order in which the camera took them.

    Attributes:
        path: the folder or video.
        prefix: prefix of the frames' names in the map.
        poses: known poses, or None.
        cameras: cameras by image name, see `find_camera`.
        timed: whether frames have times in seconds, not numbers.
        first_index: index of the first frame in the map.
        time_shift: what is added to the times of frames in the map.
    """

    timed = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.prefix = ""
        self.poses: PoseSet | None = None
        self.cameras: dict[str, Camera] = {}
        self.first_index, self.time_shift = 0, 0.0
        self._size: tuple[int, int] | None = None

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames, for a video according to its header."""

    @abstractmethod
    def _read(self, start: int, only: set[str] | None, backward: bool) -> Iterator[InputImage]: ...

    @abstractmethod
    def listing(self) -> list[tuple[str, float]]:
        """Names of all frames, without the prefix, and their times."""

    def read_poses(self, poses: Path) -> PoseSet:
        """The known poses of the frames in a file or folder, or on a topic of a bag."""
        names, times = zip(*self.listing(), strict=True)
        return poses_of_images(poses, names, times if self.timed else None)

    def names(self) -> list[str]:
        """Names of all frames, without the prefix."""
        return [name for name, _ in self.listing()]

    def shift(self, first_index: int, time_shift: float) -> None:
        """Number and time the frames so that they come after those of a map."""
        self.first_index, self.time_shift = first_index, time_shift

    def follow(self, structure: Structure, records: Collection[str]) -> None:
        """Number the frames after those of a map, and shift their times if these would mix.

        Frames whose names are among the records are not new. Times of one clock may mix, unless one
        is taken: those of one folder, and seconds in names.
        """
        first = 1 + MAX_STEP + max((f.index for f in structure.frames), default=-1)
        times = {self.prefix + name: time for name, time in self.listing()}
        new = [time for name, time in times.items() if name not in records]
        old = [frame.time for frame in structure.frames]
        overlap = bool(old and new) and min(new) <= max(old) and min(old) <= max(new)
        seconds = isinstance(self, ImageFolder) and self.timed
        one_clock = all(
            f.name in times or (seconds and f.time == _seconds(f.name)) for f in structure.frames
        )
        mixing = overlap and not (one_clock and set(new).isdisjoint(old))
        self.shift(first, math.ceil(1 + max(old) - min(new)) if mixing else 0.0)

    def images(
        self, start: int = 0, only: set[str] | None = None, backward: bool = False
    ) -> Iterator[InputImage]:
        """Yield all images, or those with these names in the map, with their known poses."""
        if only is not None:
            size = len(self.prefix)
            only = {name[size:] for name in only if name.startswith(self.prefix)}
        for image in self._read(start, only, backward):
            time = image.time if self.timed else None
            yield replace(
                image,
                index=self.first_index + image.index,
                name=self.prefix + image.name,
                time=self.time_shift + image.time,
                pose=self.poses.find(image.name, time) if self.poses else None,
                camera=self.cameras.get(image.name),
            )

    def size(self) -> tuple[int, int]:
        """Width and height of most images.

        Raises:
            ValueError: none can be read.
        """
        if self._size is None:
            images = (image.image for image in self._samples())
            sizes = Counter(image.shape[::-1] for image in images if image is not None)
            if not sizes:
                raise ValueError(
                    f"{self.path}: none of its {len(self)} frames can be read, copy it anew"
                )
            self._size = sizes.most_common(1)[0][0]
        return self._size

    def _samples(self) -> Iterator[InputImage]:
        """Images that show the size of most."""
        return self._read(0, None, False)

    def find_camera(self, cameras: CameraSet) -> Camera:
        """The camera of most images; those that a model names take their own.

        Raises:
            ValueError: there is none of their size, or several that name no image.
        """
        named = cameras.for_images(self.names()).by_image if cameras.by_image else {}
        if not named:
            return cameras.find("", *self.size())
        # COLMAP calibrates each image of one camera for itself, unless told otherwise.
        groups: list[list[Camera]] = []
        for camera in sorted(set(named.values()), key=str):
            group = next((g for g in groups if _is_same(camera, g[0])), None)
            if group is None:
                groups.append([camera])
            else:
                group.append(camera)
        middle = {c: sorted(g, key=lambda c: c.params)[len(g) // 2] for g in groups for c in g}
        self.cameras = {name: middle[camera] for name, camera in named.items()}
        return Counter(self.cameras.values()).most_common(1)[0][0]

    def known_camera(self) -> Camera | None:
        """The calibrated camera that comes with the frames, None if none does."""
        return None

    def guess_camera(self, focal: float | None = None) -> tuple[Camera, str]:
        """A camera to start calibration with, and the origin of its focal length.

        Raises:
            ValueError: the images are those of a fisheye lens, or the focal length is not positive.
        """
        width, height = self.size()
        origin = GIVEN
        if focal is None:
            focal, origin = self._exif_focal_length(), EXIF
        if focal is None and self._is_fisheye():
            raise ValueError(
                f"{self.path}: the corners of its images are black, as a fisheye lens leaves them, "
                "which mapping does not calibrate: give --camera OPENCV_FISHEYE:..., or, if it is "
                "none, --focal"
            )
        if focal is None:
            focal, origin = DEFAULT_FOCAL_RATIO * max(width, height), GUESS
        if not (np.isfinite(focal) and focal > 0):
            raise ValueError(f"--focal {focal}: give a positive number of pixels")
        return Camera(_GUESSED_MODEL, width, height, (focal, width / 2, height / 2, 0.0)), origin

    def _is_fisheye(self) -> bool:
        """Whether the image circle leaves all corners of the images black."""
        images = [i.image for i in self._samples() if i.image is not None]
        side = max(self.size()) // _CORNER
        ends = (slice(side), slice(-side, None))
        bright = [image for image in images if np.median(image) > _BLACK]
        return bool(bright) and all(
            image[y, x].max() <= _BLACK for image in bright for y in ends for x in ends
        )

    def _exif_focal_length(self) -> float | None:
        return None


class ImageFolder(FrameSource):
    """A folder of images, in natural order of their names (img2 before img10).

    Times are seconds if all names are decimal numbers such as 1305031102.175304.png, the numbers if
    they are whole, else indices.
    """

    def __init__(self, path: Path, every: int = 1) -> None:
        super().__init__(path)
        self._names = image_names(path)[::every]
        if not self._names:
            suffixes = ", ".join(suffix[1:] for suffix in IMAGE_SUFFIXES)
            raise FileNotFoundError(f"{path}: no images in this folder ({suffixes})")
        self._times, self.timed = image_times(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def listing(self) -> list[tuple[str, float]]:
        """See `FrameSource.listing`."""
        return list(zip(self._names, self._times, strict=True))

    def known_images(self, inputs: Mapping[str, str], records: Collection[str]) -> list[str]:
        """Names of images that a map has of other folders.

        Args:
            inputs: prefixes of the frames' names in the map, by folder.
            records: names of the map's frames.
        """
        others = [(Path(f), p) for f, p in inputs.items() if f != str(self.path.resolve())]
        known = {
            file_identity(folder / name.removeprefix(prefix))
            for folder, prefix in others
            for name in records
            if name.startswith(prefix)
        } - {None}
        return [name for name in self._names if file_identity(self.path / name) in known]

    def reorder(self, names: list[str]) -> None:
        """Give these images this order, in which they then come and are numbered."""
        times = dict(self.listing())
        self._names, self._times = names, [times[name] for name in names]

    def _samples(self) -> Iterator[InputImage]:
        step = -(-len(self._names) // _SIZE_SAMPLES)
        images = self._read(0, set(self._names[::step]), False)
        found = [image for image in images if image.image is not None]
        return iter(found or self._read(0, None, False))

    def _read(self, start: int, only: set[str] | None, backward: bool) -> Iterator[InputImage]:
        indices = range(start, len(self._names))
        for index in reversed(indices) if backward else indices:
            name = self._names[index]
            if only is not None and name not in only:
                continue
            image, problem = None, ""
            try:
                image = read_gray(self.path / name)
            except (OSError, ValueError) as error:
                problem = str(error)
            yield InputImage(index, name, self._times[index], image, problem=problem)

    def _exif_focal_length(self) -> float | None:
        size, images = self.size(), self._read(0, None, False)
        shown = (i.name for i in images if i.image is not None and i.image.shape[::-1] == size)
        camera = camera_from_exif(self.path / next(shown))
        return None if camera is None else camera.params[0]


class Video(FrameSource):
    """A video file, of which every n-th frame is taken."""

    timed = True

    def __init__(self, path: Path, every: int = 1) -> None:
        super().__init__(path)
        self._every = every
        self._count = -(-check_video(path) // every)

    def __len__(self) -> int:
        return self._count

    def listing(self) -> list[tuple[str, float]]:
        """See `FrameSource.listing`."""
        return [(f.name, f.time) for f in self._read_forward(0, None, decode=False)]

    def _frames(self) -> Iterator[tuple[str, float, Decode]]:
        """Names and times of the frames, and what decodes each until the next one comes."""
        return video_frames(self.path, self._every)

    def _samples(self) -> Iterator[InputImage]:
        return islice((i for i in self._read_forward(0, None) if i.image is not None), 1)

    def _read(self, start: int, only: set[str] | None, backward: bool) -> Iterator[InputImage]:
        if not backward:
            yield from self._read_forward(start, only)
            return
        # A video decodes forward only: it is decoded once per chunk, which is then reversed.
        indices = [image.index for image in self._read_forward(start, only, decode=False)]
        for last in range(len(indices), 0, -_CHUNK):
            chunk = set(indices[max(0, last - _CHUNK) : last])
            yield from reversed(list(self._read_forward(start, only, chunk)))

    def _read_forward(
        self,
        start: int,
        only: set[str] | None,
        chunk: set[int] | None = None,
        decode: bool = True,
    ) -> Iterator[InputImage]:
        for index, (name, time, read) in enumerate(self._frames()):
            if index < start or (only is not None and name not in only):
                continue
            if chunk is not None and index not in chunk:
                continue
            image = read() if decode else None
            problem = "this frame does not decode" if decode and image is None else ""
            yield InputImage(index, name, time, image, problem=problem)


class Bag(Video):
    """The images on a topic of a ROS bag, of which every n-th is taken."""

    def __init__(self, path: Path, every: int = 1, topic: str | None = None) -> None:
        FrameSource.__init__(self, path)
        self._every = every
        self.topic, count = image_topic(path, topic)
        self._count = -(-count // every)

    def _frames(self) -> Iterator[tuple[str, float, Decode]]:
        return bag_frames(self.path, self.topic, self._every)

    def read_poses(self, poses: Path) -> PoseSet:
        """See `FrameSource.read_poses`."""
        given = bag_poses(self.path, str(poses), self.topic, self.listing())
        return super().read_poses(poses) if given is None else given

    def known_camera(self) -> Camera | None:
        """The camera of the bag's CameraInfo, at the images' size.

        Raises:
            ValueError: the images have other proportions than that.
        """
        camera = bag_camera(self.path, self.topic)
        return camera and camera_of_size(self.path, camera, *self.size())


def open_source(path: Path, every: int = 1, topic: str | None = None) -> FrameSource:
    """Open a folder of images, the folder of a sequence (with images/ in it), a video, or a bag.

    Raises:
        FileNotFoundError: there is no such folder or file, or no image in it.
        ValueError: the video does not decode, or the topic is not one of the bag's.
    """
    if every < 1:
        raise ValueError(f"--every {every}: it must be at least 1")
    if path.exists() and is_bag(path):
        return Bag(path, every, topic)
    if topic is not None:
        raise ValueError(f"--topic {topic}: {path} is no ROS bag (.bag, .mcap, .db3)")
    if path.is_dir():
        return ImageFolder(path / "images" if (path / "images").is_dir() else path, every)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such folder of images, video file or ROS bag")
    check_own(path, "build {} -o scene.pmk")
    return Video(path, every)


def _seconds(name: str) -> float | None:
    times, timed = image_times([name])
    return times[0] if timed else None


def _is_same(one: Camera, other: Camera) -> bool:
    if (one.model, one.width, one.height) != (other.model, other.width, other.height):
        return False
    off = np.abs(np.subtract(one.params, other.params)).max()
    return bool(off <= _SAME_CAMERA * one.params[0])
