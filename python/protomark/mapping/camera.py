"""The camera of the frames: given, or guessed and then calibrated along the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protomark.mapping.source import Folder, Video
from protomark.tracks.colmap import pycolmap, quiet, read_cameras
from protomark.tracks.file import Camera

# Focal length of an unknown camera, as a share of the longer side: COLMAP's guess.
PRIOR_FOCAL = 1.2
_GUESSED_MODEL = "SIMPLE_RADIAL"


def given_camera(text: str, size: tuple[int, int]) -> Camera:
    """The camera of a COLMAP cameras file or model folder, or one that is written out.

    Args:
        text: a path, or such as PINHOLE:500,500,320,240 (COLMAP's order of parameters), or as in
            a cameras.txt, PINHOLE 640 480 500 500 320 240.
        size: width and height of the images.

    Raises:
        FileNotFoundError: neither a file nor of that form.
        ValueError: there is no camera of this size, or several.
    """
    if text.partition(":")[0].partition(" ")[0].upper() in pycolmap.CameraModelId.__members__:
        return _written_out(text, size)
    path = Path(text)
    if not path.exists():
        raise FileNotFoundError(
            f"{text}: no such file; --camera takes a COLMAP cameras.txt or, for example, "
            "PINHOLE:500,500,320,240"
        )
    cameras = read_cameras(path)
    fitting = {c for c in cameras.values() if (c.width, c.height) == size}
    if len(fitting) != 1:
        sizes = ", ".join(sorted({f"{c.width}x{c.height}" for c in cameras.values()}))
        raise ValueError(
            f"{text}: {len(fitting) or 'no'} cameras for images of {size[0]}x{size[1]} pixels "
            f"(its cameras have {sizes or 'no size'}); give one with --camera MODEL:PARAMS"
        )
    return fitting.pop()


def _written_out(text: str, size: tuple[int, int]) -> Camera:
    words = text.replace(":", " ").replace(",", " ").split()
    sized = ":" not in text
    try:
        numbers = [float(word) for word in words[1:]]
        given = (int(numbers[0]), int(numbers[1])) if sized else size
        camera = Camera(words[0].upper(), *given, tuple(numbers[2 if sized else 0 :]))
        if not np.isfinite(numbers).all() or not _fine(camera):
            raise ValueError
    except (ValueError, RuntimeError, IndexError, OverflowError):
        raise ValueError(
            f"--camera {text}: these are not the parameters of a {words[0].upper()} camera, "
            "see https://colmap.github.io/cameras.html"
        ) from None
    if given != size:
        raise ValueError(
            f"--camera {text}: the images have {size[0]}x{size[1]} pixels; scale the parameters"
        )
    return camera


def guessed_camera(source: Folder | Video, focal: float | None = None) -> tuple[Camera, str]:
    """A camera to begin with, and where its focal length is from.

    Args:
        source: the frames.
        focal: focal length in pixels; None: from EXIF, else 1.2 times the longer side.
    """
    width, height = source.size()
    origin = "given"
    if focal is None and isinstance(source, Folder):
        with quiet():
            try:
                inferred = pycolmap.infer_camera_from_image(str(source.path / source.names[0]))
            except (ValueError, RuntimeError):
                inferred = None
        if inferred is not None and inferred.has_prior_focal_length:
            focal, origin = float(inferred.mean_focal_length()), "EXIF"
    if focal is None:
        focal, origin = PRIOR_FOCAL * max(width, height), "a guess"
    if not (np.isfinite(focal) and focal > 0):
        raise ValueError(f"--focal {focal}: give a positive number of pixels")
    return Camera(_GUESSED_MODEL, width, height, (focal, width / 2, height / 2, 0.0)), origin


def _fine(camera: Camera) -> bool:
    ours = pycolmap.Camera(camera.as_dict())
    return bool(ours.verify_params() and ours.mean_focal_length() > 0)
