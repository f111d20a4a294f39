"""One small real map, so that everything runs after install.

The tracks of the sequence "toy" (a toy on a textured table; github.com/sfmtool/sfmtool,
Apache-2.0): FREAK keypoints and descriptors, poses and landmarks that `protomark tracks` computed;
no image.
"""

from __future__ import annotations

from pathlib import Path

from protomark.tracks.file import Tracks

NAME = "toy.freak.safetensors"


def path() -> Path:
    """The tracks file that ships.

    Raises:
        FileNotFoundError: the installation lacks it.
    """
    file = Path(__file__).parent / NAME
    if not file.is_file():
        raise FileNotFoundError(f"{file}: the sample is missing, reinstall protomark")
    return file


def load() -> Tracks:
    """The bundled tracks. Raises FileNotFoundError where the installation lacks them."""
    return Tracks.load(path())
