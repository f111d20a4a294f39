"""Reads maps of other programs as tracks, one module per format."""

from __future__ import annotations

from importlib import import_module
from itertools import islice
from pathlib import Path
from types import ModuleType

from protomark._core import FileError
from protomark.features.bag import is_bag
from protomark.files import SCENE_MAP
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
_BELOW = 100  # files and folders of a folder that are looked at
_HEAD = 4096  # bytes by which a file is recognized
MAGIC = b"PROTOMRK"  # with which the files of Protomark begin


def find_importer(path: Path) -> ModuleType | None:
    """The module that reads the map of another program at a path, None if none does.

    Raises:
        FileNotFoundError: there is no such file or folder.
    """
    head = file_head(path)
    return next((m for m in _modules() if m.recognizes(path, head)), None)


def read_source(path: Path) -> Tracks:
    """Read the map of another program, which its content tells.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: no known program wrote it, or it is broken.
    """
    module = find_importer(path)
    if module is None:
        check_below(path)
        *programs, last = (m.PROGRAM for m in _modules())
        raise ValueError(
            f"{path} is {_guess(path)}: give tracks of `protomark tracks`, or a map of "
            f"{', '.join(programs)} or {last}"
        )
    tracks: Tracks = module.read(path)
    return tracks


def check_own(path: Path, command: str) -> None:
    """Raise FileError if a path holds a map of another program, which a command reads."""
    try:
        module = None if file_head(path).startswith(MAGIC) else find_importer(path)
    except OSError:
        return  # whoever opens it says what is wrong
    if module is not None:
        raise FileError(
            f"{path} is a map of {module.PROGRAM}, which `protomark {command.format(path)}` reads"
        )


def check_below(folder: Path) -> None:
    """Raise ValueError if something in a folder is a map of another program, which it names."""
    for path in islice(sorted(folder.iterdir()), _BELOW) if folder.is_dir() else ():
        if module := find_importer(path):
            name = f"{path.name}{'/' if path.is_dir() else ''}"
            raise ValueError(f"{folder} holds a map of {module.PROGRAM} in {name}: name that")


def _guess(path: Path) -> str:
    """What a path that no module reads may be."""
    head = file_head(path)
    if head.startswith(MAGIC) or (path / SCENE_MAP).is_file():
        return "what Protomark wrote already, which `protomark seal` and `merge` take"
    if is_bag(path):
        return "a recording, which `protomark map` reads"
    if head.startswith(b"SQLite format 3\0"):
        return "a database that is cut off, broken, or of another program"
    if path.suffix in (".mappoints", ".keyframes", ".features"):
        return "a part of a map that osmap saved, whose .yaml names all of them"
    return "no map that can be read"


def file_head(path: Path) -> bytes:
    """The first bytes of a file, none of a folder.

    Raises:
        FileNotFoundError: there is neither.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(_HEAD)


def _modules() -> list[ModuleType]:
    return [import_module(f"{__name__}.{name}") for name in _MODULES]
