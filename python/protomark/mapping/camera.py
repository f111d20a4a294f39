"""The camera of frames that come without one: guessed, and then calibrated along the way."""

from __future__ import annotations

import numpy as np

from protomark.localization.cameras import camera_of_exif
from protomark.mapping.source import Folder, Video
from protomark.tracks.file import Camera

# Focal length of an unknown camera, as a share of the longer side: COLMAP's guess.
PRIOR_FOCAL = 1.2
_GUESSED_MODEL = "SIMPLE_RADIAL"


def guessed_camera(source: Folder | Video, focal: float | None = None) -> tuple[Camera, str]:
    """A camera to begin with, and where its focal length is from.

    Args:
        source: the frames.
        focal: focal length in pixels; None: from EXIF, else 1.2 times the longer side.
    """
    width, height = source.size()
    origin = "given"
    if focal is None and isinstance(source, Folder):
        inferred = camera_of_exif(source.path / source.names[0])
        if inferred is not None:
            focal, origin = inferred.params[0], "EXIF"
    if focal is None:
        focal, origin = PRIOR_FOCAL * max(width, height), "a guess"
    if not (np.isfinite(focal) and focal > 0):
        raise ValueError(f"--focal {focal}: give a positive number of pixels")
    return Camera(_GUESSED_MODEL, width, height, (focal, width / 2, height / 2, 0.0)), origin
