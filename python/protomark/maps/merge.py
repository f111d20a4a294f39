"""Merges maps that were built apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.files import check_outputs
from protomark.maps.open import map_path, open_learning_map
from protomark.progress import Progress, silent, tracked

MAX_ID = 2**63 - 1
# So many common ids tell whether they are the same landmarks in one world: then the prototypes of
# most are more alike than those of different landmarks, and few positions are off by much.
_MIN_COMMON = 30
_MIN_ALIKE = 0.75
_MAX_SHIFT = 0.1


def merge_files(
    inputs: Sequence[Path], output: Path, renumber: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Merge learning maps, in this order, into the map file `output`; returns facts as JSON.

    With `renumber`, landmarks of different files differ, whatever their ids: those of each further
    file get new ids above all earlier ones.
    """
    check_outputs(output, inputs=[map_path(path, learning=True) for path in inputs])
    if len(inputs) < 2:
        raise ValueError("name at least two maps to merge")
    resolved = [map_path(path, learning=True).resolve() for path in inputs]
    for path, same in zip(inputs, resolved, strict=True):
        if resolved.count(same) > 1:
            raise ValueError(f"{path} is named twice, and its observations would count twice")
    files: list[dict[str, Any]] = []
    merged: pm.PrototypeMap | None = None
    for path in tracked(inputs, progress, "merge"):
        scene = open_learning_map(path)
        facts = {"file": str(path), "landmarks": len(scene), "in_common": 0}
        if merged is None:
            merged = scene
        else:
            before = len(merged)
            try:
                if renumber:
                    _merge_renumbered(merged, scene)
                else:
                    _check_common(merged, scene)
                    merged.merge_map(scene)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
            facts["in_common"] = before + len(scene) - len(merged)
        files.append(facts)
    assert merged is not None
    merged.save(output)
    return {
        "kind": "learning map",
        "inputs": files,
        "landmarks": len(merged),
        "dim": merged.dim,
        "appearance_bits": merged.appearance_bits or None,
        "bytes": output.stat().st_size,
    }


def _check_common(merged: pm.PrototypeMap, scene: pm.PrototypeMap) -> None:
    """Raise ValueError if landmarks of one id are different ones, or in different worlds."""
    common = np.intersect1d(merged.ids, scene.ids, assume_unique=True)
    if len(common) < _MIN_COMMON:
        return
    ours, theirs = merged.prototypes(common), scene.prototypes(common)
    others = np.roll(theirs, len(common) // 2, axis=0)
    same, different = (((ours - codes) ** 2).sum(axis=1) for codes in (theirs, others))
    if (same < different).mean() < _MIN_ALIKE:
        raise ValueError(
            f"{len(common):,} ids are in an earlier map, too, but stand for other landmarks there, "
            "as the prototypes show: --renumber merges maps that number their landmarks each on "
            "its own; `protomark map IMAGES --into FOLDER` adds a scene's images to its map"
        )
    before, now = merged.positions(common), scene.positions(common)
    both = np.isfinite(before + now).all(axis=1)
    if both.sum() < _MIN_COMMON:
        return
    shift, reach = (
        np.median(np.linalg.norm(before[both] - to, axis=1))
        for to in (now[both], np.median(before[both], axis=0))
    )
    if shift > _MAX_SHIFT * reach:
        raise ValueError(
            f"its landmarks lie elsewhere than in an earlier map ({shift:.3g} away, median), which "
            "is in other coordinates or of another scale: bring both into one world first "
            "(`set_positions`)"
        )


def _merge_renumbered(merged: pm.PrototypeMap, scene: pm.PrototypeMap) -> None:
    theirs, existing = scene.ids, merged.ids
    if not (len(theirs) and len(existing)):
        merged.merge_map(scene)
        return
    first = int(existing[-1]) + 1
    if int(theirs[-1]) > MAX_ID - first:
        raise ValueError(
            f"ids from {first} on leave no room for those up to {theirs[-1]}: use smaller ids"
        )
    merged.merge_map(scene, into=theirs + first, source=theirs)
