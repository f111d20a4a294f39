"""Reads maps of other programs as tracks, one module per format."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

from protomark._core import FileError
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
    """Raise ValueError if a folder's first folder with a map of another program is to be named."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and (module := find_importer(path)):
            raise ValueError(f"{folder} holds a map of {module.PROGRAM} in {path.name}/: name that")


def _guess(path: Path) -> str:
    """What a path that no module reads may be."""
    head = file_head(path)
    if head.startswith(MAGIC):
        return "a file of Protomark already, which `protomark seal` and `merge` take"
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
