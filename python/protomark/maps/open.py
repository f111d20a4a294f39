"""Opens a map from its file, or from the folder that `protomark map` wrote."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, overload

from protomark import _core
from protomark._core import PrototypeMap, SealedMap
from protomark.files import MANIFEST, SCENE_MAP, SEALED_MAP


def map_path(path: str | os.PathLike[str], *, learning: bool = False) -> Path:
    """The map file at a path: the path itself, or the map in a folder of `protomark map`.

    Of a folder it is the sealed map, which the mapper removes when the learning map has changed, or
    else the learning map. With `learning` only that counts.

    Raises:
        FileNotFoundError: the folder holds no such map.
        FileError: it is a map of another program.
        ValueError: the folder holds one of another program.
    """
    path = Path(path)
    if not path.is_dir():
        _check_own(path)
        return path
    for name in (SCENE_MAP,) if learning else (SEALED_MAP, SCENE_MAP):
        if (path / name).is_file():
            return path / name
    if (path / MANIFEST).is_file():
        raise ValueError(f"{path} is a folder of shards: name one of its map files")
    _check_own(path)
    from protomark.tracks.importers import check_below

    check_below(path)
    raise FileNotFoundError(f"{path} holds no {SCENE_MAP}: name a map file")


def is_map(path: Path) -> bool:
    """Whether a path is a map file by its suffix, or the folder of a map."""
    if path.is_dir():
        return any((path / name).is_file() for name in (SCENE_MAP, SEALED_MAP, MANIFEST))
    return path.suffix == ".pmk"


def _check_own(path: Path) -> None:
    from protomark.tracks.importers import check_own

    check_own(path, "build {} -o scene.pmk")


@overload
def open_map(  # what can commit is a learning map
    path: str | os.PathLike[str],
    *,
    journal: Literal[True],
    encoder: _core.Encoder | None = None,
    descriptor: str | None = None,
) -> PrototypeMap: ...
@overload
def open_map(
    path: str | os.PathLike[str],
    *,
    journal: bool = False,
    encoder: _core.Encoder | None = None,
    descriptor: str | None = None,
) -> PrototypeMap | SealedMap: ...
def open_map(
    path: str | os.PathLike[str],
    *,
    journal: bool = False,
    encoder: _core.Encoder | None = None,
    descriptor: str | None = None,
) -> PrototypeMap | SealedMap:
    """Open a map: read a learning map, with what was committed to its journal, or map a sealed one.

    A map encodes descriptors itself, with the encoder that it was built with. If they are encoded
    elsewhere, or come from a detector that the map has not seen, say what you have.

    Args:
        path: the map file, or the folder that `protomark map` wrote (see `map_path`).
        journal: let the map commit to the journal beside the file, which is made if there is none.
            No other map can be opened with it until this one is closed or destroyed.
        encoder: the map must have been made with this encoder, or one of equal identity.
        descriptor: the map must be one of this descriptor, for example "orb".

    Raises:
        FileNotFoundError: the folder holds no map.
        FileError: the file is not a map, or is broken; with journal also if it is sealed, or
            another map has the journal.
        ValueError: the map is of another encoder or descriptor.
    """
    file = map_path(path, learning=journal)
    return _core.open(file, journal=journal, encoder=encoder, descriptor=descriptor)


def open_learning_map(path: Path) -> PrototypeMap:
    """Open a map that takes observations, by its file or the folder of `protomark map`."""
    path = map_path(path, learning=True)
    scene = open_map(path)
    if not isinstance(scene, PrototypeMap):
        raise ValueError(f"{path} is a sealed map, which keeps no sums: give the learning map")
    return scene
