"""Frames one after the other: a folder of images, or a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.mapping.mapper import Picture
from protomark.tracks.colmap import natural_key
from protomark.tracks.features import read_gray

_CHUNK = 64
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp")


@dataclass(frozen=True)
class Folder:
    """A folder of images, in natural order of their names (img2 before img10).

    Attributes:
        path: the folder.
        names: image names, relative to it.
        times: seconds, if all names are decimal numbers such as 1305031102.175304.png; else places.
    """

    path: Path
    names: list[str]
    times: list[float]

    def __len__(self) -> int:
        return len(self.names)

    def pictures(
        self, start: int = 0, only: set[str] | None = None, backward: bool = False
    ) -> Iterator[Picture]:
        """Pictures from a place on, or those of some names, or from the last to the first."""
        places = range(start, len(self.names))
        for index in reversed(places) if backward else places:
            name = self.names[index]
            if only is not None and name not in only:
                continue
            image, trouble = None, ""
            try:
                image = read_gray(self.path / name)
            except (OSError, ValueError) as error:
                trouble = str(error)
            yield Picture(index, name, self.times[index], image, trouble=trouble)

    def size(self) -> tuple[int, int]:
        """Width and height of the first image that can be read."""
        for picture in self.pictures():
            if picture.image is not None:
                return picture.image.shape[1], picture.image.shape[0]
        raise ValueError(f"{self.path}: none of its {len(self)} images can be read")


@dataclass(frozen=True)
class Video:
    """A video file, of which every n-th frame counts.

    Attributes:
        path: the file.
        every: step between frames that are taken.
        count: frames that are taken, as the file says; some say it wrongly.
        rate: frames a second of the file.
    """

    path: Path
    every: int
    count: int
    rate: float

    def __len__(self) -> int:
        return self.count

    def pictures(
        self, start: int = 0, only: set[str] | None = None, backward: bool = False
    ) -> Iterator[Picture]:
        """Pictures from a place on, or those of some names, or from the last to the first.

        Backward decodes the video anew for each `_CHUNK` frames, which it holds in memory.
        """
        if not backward:
            yield from self._forward(start, only)
            return
        wanted = [p.index for p in self._forward(start, only, decode=False)]
        for last in range(len(wanted), 0, -_CHUNK):
            chunk = set(wanted[max(0, last - _CHUNK) : last])
            yield from reversed(list(self._forward(start, only, chunk)))

    def _forward(
        self,
        start: int,
        only: set[str] | None,
        chunk: set[int] | None = None,
        decode: bool = True,
    ) -> Iterator[Picture]:
        video = _open_video(self.path)
        try:
            place = 0
            while video.grab():
                index, rest = divmod(place, self.every)
                name = f"{self.path.stem}-{place:06d}"
                place += 1
                if rest or index < start or (only is not None and name not in only):
                    continue
                if chunk is not None and index not in chunk:
                    continue
                if not decode:
                    yield Picture(index, name, 0.0, None)
                    continue
                fine, image = video.retrieve()
                gray, trouble = (_gray(image), "") if fine else (None, "this frame does not decode")
                yield Picture(index, name, (place - 1) / self.rate, gray, trouble=trouble)
        finally:
            video.release()

    def size(self) -> tuple[int, int]:
        """Width and height of the first frame."""
        for picture in self.pictures():
            if picture.image is not None:
                return picture.image.shape[1], picture.image.shape[0]
        raise ValueError(f"{self.path}: no frame of this video decodes, convert it with ffmpeg")


def open_source(path: Path, every: int = 1) -> Folder | Video:
    """A folder of images or a video.

    Args:
        path: folder or file.
        every: take every n-th frame only.

    Raises:
        FileNotFoundError: there is no such folder or file, or no image in it.
        ValueError: the video does not decode.
    """
    if every < 1:
        raise ValueError(f"--every {every}: it must be at least 1")
    if path.is_dir():
        # A sequence folder holds its images in images/.
        if (path / "images").is_dir():
            path = path / "images"
        files = [f for f in path.rglob("*") if f.suffix.lower() in SUFFIXES and f.is_file()]
        names = sorted((f.relative_to(path).as_posix() for f in files), key=natural_key)[::every]
        if not names:
            raise FileNotFoundError(
                f"{path}: no images in this folder ({', '.join(s[1:] for s in SUFFIXES)})"
            )
        return Folder(path, names, _times(names))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such folder of images or video file")
    import cv2

    video = _open_video(path)
    count, rate = (float(video.get(p)) for p in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    fine = video.grab()
    video.release()
    if not fine:
        raise ValueError(f"{path}: no frame of this video decodes, convert it with ffmpeg")
    rate = rate if np.isfinite(rate) and rate > 0 else 30.0
    return Video(path, every, max(1, -(-int(max(count, 1)) // every)), rate)


def _times(names: list[str]) -> list[float]:
    stems = [Path(name).stem for name in names]
    try:
        if all("." in stem for stem in stems):
            times = [float(stem) for stem in stems]
            if np.isfinite(times).all() and (np.diff(times) > 0).all():
                return times
    except ValueError:
        pass
    return [float(i) for i in range(len(names))]


def _open_video(path: Path) -> Any:
    import cv2

    # OpenCV and FFmpeg print what they think of a broken file; our sentence says it.
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        video = cv2.VideoCapture(str(path))
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not video.isOpened():
        raise ValueError(
            f"{path}: not a video that OpenCV can decode; convert it, for example with "
            "ffmpeg -i IN -c:v libx264 OUT.mp4, or give a folder of images"
        )
    return video


def _gray(image: Any) -> NDArray[np.uint8]:
    import cv2

    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(image, np.uint8)
