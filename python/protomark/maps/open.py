"""Opens a map from its file, or from the folder that `protomark map` wrote."""

from __future__ import annotations

from pathlib import Path

import protomark as pm

# Name of the map in the folder that `protomark map` writes.
SCENE_MAP = "scene.pmk"


def map_path(path: str | Path) -> Path:
    """The map file at a path: the path itself, or the map in a folder of `protomark map`.

    Raises:
        FileNotFoundError: the folder holds no map.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    if not (path / SCENE_MAP).is_file():
        raise FileNotFoundError(f"{path} holds no {SCENE_MAP}: name a map file")
    return path / SCENE_MAP


def open_map(path: str | Path) -> pm.PrototypeMap | pm.SealedMap:
    """Open a map file, or the map in a folder of `protomark map`.

    Raises:
        FileNotFoundError, FileError: there is no map at the path, or it is broken.
    """
    return pm.open(map_path(path))
