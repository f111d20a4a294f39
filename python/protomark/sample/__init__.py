"""One small real sequence, so that everything runs right after installation.

These are the tracks of the sequence "toy" (a toy on a textured table; github.com/sfmtool/sfmtool,
Apache-2.0): FREAK keypoints and descriptors, poses and landmarks, which `protomark tracks` computed
from its images.
"""

from __future__ import annotations

from pathlib import Path

from protomark.tracks.file import Tracks

NAME = "toy.freak.safetensors"


def path() -> Path:
    """The path of the bundled tracks file.

    Raises:
        FileNotFoundError: the installation lacks it.
    """
    file = Path(__file__).parent / NAME
    if not file.is_file():
        raise FileNotFoundError(f"{file}: the sample is missing, reinstall protomark")
    return file


def load() -> Tracks:
    """Load the bundled tracks; raises FileNotFoundError if the installation lacks them."""
    return Tracks.load(path())
