"""Reads maps of other programs as tracks, one module per format."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from protomark.tracks.file import Tracks

# Asked in this order whether a file or folder is theirs.
_MODULES = (
    "orbslam3",
    "osmap",
    "stella",
    "rtabmap",
    "openmvg",
    "opensfm",
    "kapture",
    "astrobee",
)
_HEAD = 4096  # bytes by which a file is recognized


def read_source(path: Path) -> Tracks:
    """Read the map of another program, which its content tells.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: no known program wrote it, or it is broken.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(_HEAD)
    programs = []
    for name in _MODULES:
        if find_spec(f"{__name__}.{name}") is None:
            continue
        module = import_module(f"{__name__}.{name}")
        programs.append(module.PROGRAM)
        if module.recognizes(path, head):
            tracks: Tracks = module.read(path)
            return tracks
    raise ValueError(
        f"{path} is no map that can be read: give tracks of `protomark tracks`, or a map of "
        f"{', '.join(programs[:-1])} or {programs[-1]}"
    )
