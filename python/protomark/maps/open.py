"""Opens a map from its file, or from the folder that `protomark map` wrote."""

from __future__ import annotations

from pathlib import Path

import protomark as pm

# The maps in the folder that `protomark map` writes: the one that learns, and the one that ships.
SCENE_MAP = "scene.pmk"
SEALED_MAP = "scene.sealed.pmk"


def map_path(path: str | Path) -> Path:
    """The map file at a path: the path itself, or the map in a folder of `protomark map`.

    Of a folder it is the sealed map, which the mapper removes when the learning map has changed, or
    else the learning map.

    Raises:
        FileNotFoundError: the folder holds no map.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    for name in (SEALED_MAP, SCENE_MAP):
        if (path / name).is_file():
            return path / name
    raise FileNotFoundError(f"{path} holds no {SCENE_MAP}: name a map file")


def open_map(path: str | Path) -> pm.PrototypeMap | pm.SealedMap:
    """Open a map file, or the map in a folder of `protomark map`.

    Raises:
        FileNotFoundError, FileError: there is no map at the path, or it is broken.
    """
    return pm.open(map_path(path))
