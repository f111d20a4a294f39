"""Splits a map into parts that can be served apart, or crops it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import protomark as pm
from protomark.files import MANIFEST, check_outputs
from protomark.geometry.colmap import find_model, landmarks_by_image
from protomark.maps.open import map_path, open_learning_map
from protomark.maps.shards import (
    Manifest,
    check_manifest,
    describe_file,
    describe_shard,
    encoder_facts,
)
from protomark.progress import Progress, silent, tracked


def split_file(
    path: Path,  # the map file, NAME.pmk, or the folder of `protomark map`
    folder: Path,  # folder of the parts, created if it does not exist
    ids: list[int] | None = None,  # ascending ids, at each of which a part starts
    parts: int | None = None,  # number of parts by id, of equally many landmarks (give or take one)
    # Edge of the cubes that divide space, in the unit of the positions.
    cell_size: float | None = None,
    sealed: bool = False,  # whether to seal the parts
    progress: Progress = silent,
) -> dict[str, Any]:
    """Split a learning map by `ids`, `parts` or `cell_size`; returns facts as JSON values.

    The files are NAME.0.pmk, NAME.1.pmk, ... by id, and NAME.I_J_K.pmk and NAME.nowhere.pmk by
    space; sealed ones are NAME.0.sealed.pmk and so on. A part without landmarks has no file. With
    the manifest beside them the folder opens as one map (`pm.ShardedMap`).
    """
    if sum(option is not None for option in (ids, parts, cell_size)) != 1:
        raise ValueError("give one of --ids, --parts and --cell-size to split by")
    if ids is not None and any(a >= b for a, b in pairwise(ids)):
        raise ValueError(f"--ids {','.join(map(str, ids))}: ids must ascend")
    if cell_size is not None and not 0 < cell_size < math.inf:
        raise ValueError(f"--cell-size {cell_size:g} is not above 0")
    path = map_path(path, learning=True)
    scene = open_learning_map(path)
    named = _by_space(scene, cell_size) if cell_size is not None else _by_id(scene, ids, parts)
    kind, ending = ("sealed", ".sealed.pmk") if sealed else ("learning", ".pmk")
    files = [(folder / f"{path.stem}.{name}{ending}", part) for name, part in named if len(part)]
    for file, _ in files:
        if file.exists() and file.samefile(path):
            raise ValueError(f"{file} is the map itself: name another folder")
    check_manifest(folder)
    before = Manifest.load(folder) if (folder / MANIFEST).is_file() else None
    folder.mkdir(parents=True, exist_ok=True)
    replaced = [str(file) for file, _ in files if file.exists()]
    written, shards = [], []
    for file, part in tracked(files, progress, "write"):
        if sealed:
            part.seal(file)
        else:
            part.save(file)
        name = file.name.removesuffix(ending)
        shards.append(describe_shard(name, part, **{kind: describe_file(file)}))
        written.append(
            {
                "file": str(file),
                "landmarks": len(part),
                "ids": list(shards[-1].ids),
                "bytes": file.stat().st_size,
            }
        )
    Manifest(
        encoder_facts(scene.encoder), scene.dim, scene.appearance_bits, dict(scene.metadata), shards
    ).save(folder)
    removed = _remove_shards(folder, before, {file.name for file, _ in files} | {path.name})
    return {
        "map": str(path),
        "landmarks": len(scene),
        "parts": written,
        "replaced": replaced,
        "removed": removed,
    }


def _remove_shards(folder: Path, before: Manifest | None, kept: set[str]) -> list[str]:
    """Remove the files of an earlier split, which would be merged with those of this one."""
    removed = []
    for shard in before.shards if before else ():
        for file in shard.files:
            old = folder / file.name
            # What the user has put in their place since is the user's.
            if file.name not in kept and old.is_file() and describe_file(old) == file:
                old.unlink()
                removed.append(str(old))
    return removed


def crop_file(
    path: Path,
    output: Path,
    box: Sequence[float] | None = None,  # lowest x, y, z and highest x, y, z
    near: Sequence[float] | None = None,  # x, y, z and a distance
    images: Sequence[str] | None = None,  # names of images, or patterns of names
) -> dict[str, Any]:
    """Write the landmarks in a box, near a point, or that images see, as a map; returns facts.

    Raises:
        ValueError: not exactly one of `box`, `near` and `images` is given, it is none, or it holds
            no landmark.
    """
    if sum(region is not None for region in (box, near, images)) != 1:
        raise ValueError("give one of --box, --near and --images to crop by")
    check_outputs(inputs=[map_path(path, learning=True)], maps=[output])
    scene = open_learning_map(path)
    ids = scene.ids
    positions = scene.positions(ids)
    inside: NDArray[np.bool_]
    if images is not None:
        inside = np.isin(ids, _seen_in(path, images))
    elif box is not None:
        low, high = np.array(box[:3]), np.array(box[3:])
        if len(box) != 6 or not (low <= high).all():
            raise ValueError("--box needs six numbers, the lowest x,y,z and the highest x,y,z")
        inside = np.asarray(((positions >= low) & (positions <= high)).all(axis=1))
    else:
        assert near is not None
        if len(near) != 4 or not near[3] > 0:
            raise ValueError("--near needs four numbers: x,y,z and a distance above 0")
        inside = np.linalg.norm(positions - near[:3], axis=1) <= near[3]
    placed = np.isfinite(positions).all(axis=1)
    if not inside.any():
        extent = positions[placed].min(axis=0), positions[placed].max(axis=0)
        told = (
            " to ".join(",".join(f"{x:.4g}" for x in p) for p in extent) if placed.any() else "no"
        )
        raise ValueError(f"{path}: no landmark is there; the map has positions from {told}")
    part = scene.part(ids[inside])
    part.metadata = scene.metadata
    part.save(output)
    return {
        "map": str(path),
        "landmarks": len(scene),
        "without_position": 0 if images is not None else int((~placed).sum()),
        "kept": len(part),
        "bytes": output.stat().st_size,
    }


def _seen_in(folder: Path, patterns: Sequence[str]) -> NDArray[np.int64]:
    """Landmarks that images of a folder's model see."""
    if not folder.is_dir():
        raise ValueError(
            f"{folder} does not know which images saw its landmarks: name the folder of "
            "`protomark map` for --images"
        )
    seen = landmarks_by_image(find_model(folder))
    chosen: set[str] = set()
    for pattern in patterns:
        found = {name for name in seen if name == pattern or fnmatchcase(name, pattern)}
        if not found:
            raise ValueError(
                f"--images {pattern}: no image of the map has such a name; the first is {min(seen)}"
            )
        chosen |= found
    return np.concatenate([seen[name] for name in chosen])


def _by_id(
    scene: pm.PrototypeMap, boundaries: list[int] | None, parts: int | None
) -> list[tuple[str, pm.PrototypeMap]]:
    if boundaries is None:
        ids = scene.ids
        if parts is None or not 1 <= parts <= len(ids):
            raise ValueError(
                f"--parts {parts}: a map of {len(ids)} landmarks has 1 to {len(ids)} parts"
            )
        boundaries = ids[np.arange(1, parts) * len(ids) // parts].tolist()
    width = len(str(len(boundaries)))
    return [(f"{i:0{width}}", part) for i, part in enumerate(scene.split_by_id(boundaries))]


def _by_space(scene: pm.PrototypeMap, cell_size: float) -> list[tuple[str, pm.PrototypeMap]]:
    return [
        ("nowhere" if cell is None else "_".join(map(str, cell)), part)
        for cell, part in scene.split_by_space(cell_size).items()
    ]
