"""Reads the frames of a video."""

from __future__ import annotations

import math
import mimetypes
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.extras import optional
from protomark.features.images import IMAGE_SUFFIXES, to_gray

# Decodes a frame as (height, width) uint8; None if it does not decode.
Decode = Callable[[], NDArray[np.uint8] | None]


def is_video(path: Path) -> bool:
    """Whether a file is a video, or at least no image but named like a video."""
    if path.suffix.lower() in IMAGE_SUFFIXES or optional("cv2").haveImageReader(str(path)):
        return False
    if (mimetypes.guess_type(path.name)[0] or "").startswith("video/"):
        return True
    try:
        check_video(path)
    except ValueError:
        return False
    return True


def check_video(path: Path) -> int:
    """The number of a video's frames, according to its header.

    Raises:
        ValueError: OpenCV cannot decode the video.
    """
    video = open_video(path)
    count = float(video.get(optional("cv2").CAP_PROP_FRAME_COUNT))
    decodes = video.grab()
    video.release()
    if not decodes:
        raise ValueError(f"{path}: no frame of this video decodes, convert it with ffmpeg")
    return int(max(count, 1))


def video_frames(path: Path, every: int = 1) -> Iterator[tuple[str, float, Decode]]:
    """Name and time in seconds of every n-th frame, and what decodes it until the next one comes.

    Raises:
        ValueError: OpenCV cannot decode the video.
    """
    cv2, video = optional("cv2"), open_video(path)
    rate = float(video.get(cv2.CAP_PROP_FPS))
    step = 1 / rate if math.isfinite(rate) and rate > 0 else 1 / 30

    def decode() -> NDArray[np.uint8] | None:
        decoded, image = video.retrieve()
        return to_gray(np.asarray(image)) if decoded else None

    try:
        number, time = -1, -step
        while video.grab():
            number += 1
            # Frames need not follow each other at one rate; not every decoder knows when.
            shown = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            time = shown if shown > time else time + step
            if number % every == 0:
                yield f"{path.stem}-{number:06d}", time, decode
    finally:
        video.release()


def open_video(path: Path) -> Any:
    """Open a video as a `cv2.VideoCapture`; ValueError if OpenCV cannot decode it."""
    cv2 = optional("cv2")
    # OpenCV and FFmpeg would print their own view of a broken file.
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
