"""Merges maps that were built apart, in one world or each in its own."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import protomark as pm
from protomark.files import check_outputs
from protomark.geometry.similarity import Array
from protomark.maps import cameras
from protomark.maps.alignment import Alignment, Ids, align_maps
from protomark.maps.open import map_path, open_learning_map
from protomark.maps.origin import joint_origin
from protomark.progress import Progress, silent

MAX_ID = 2**63 - 1
# So many common ids tell whether they are the same landmarks in one world: then the prototypes of
# most are more alike than those of different landmarks, and few positions are off by much.
_MIN_COMMON = 30
_MIN_ALIKE = 0.75
_MAX_SHIFT = 0.1


# So many landmarks tell whether maps without common ids are of different worlds.
_PROBED = 2_000


@dataclass
class Merged:
    """What became of maps that were merged.

    Attributes:
        facts: what `protomark merge --json` writes.
        landmarks: for each input (l, 3) positions of its landmarks, in the world of the first.
        common: (c, 3) positions of landmarks by which inputs were recognized.
    """

    facts: dict[str, Any]
    landmarks: list[Array]
    common: Array

    @classmethod
    def begin(cls, path: Path, scene: pm.PrototypeMap) -> Merged:
        """Begin with the first map."""
        merged = cls({"inputs": []}, [], np.zeros((0, 3)))
        merged.note(path, scene, None, 0)
        return merged

    def note(
        self, path: Path, scene: pm.PrototypeMap, found: Alignment | None, in_common: int
    ) -> None:
        """Note a map that was merged, before it changes."""
        positions = scene.positions(scene.ids)
        if found is not None:
            common = found.similarity(scene.positions(found.source))
            positions, self.common = found.similarity(positions), np.vstack([self.common, common])
        self.landmarks.append(positions)
        self.facts["inputs"].append(
            {
                "file": str(path),
                "landmarks": len(scene),
                "in_common": in_common,
                "moved": None if found is None else found.facts(),
            }
        )


def merge_files(
    inputs: Sequence[Path],
    output: Path,
    *,
    renumber: bool = False,
    align: bool = False,
    fixed_scale: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Merged:
    """Merge learning maps, in the order that `merge_each` says, into the map file `output`.

    Landmarks of one id are one landmark, if the maps agree on that. Otherwise each map numbers its
    landmarks in a world of its own: it is moved into that of the first, and duplicates are merged.

    Args:
        inputs: map files, or folders of `protomark map`.
        output: the map file to write.
        renumber: landmarks of different files differ, whatever their ids, in one world: those of
            each further file get new ids above all earlier ones.
        align: each map has a world of its own, whatever the ids say.
        fixed_scale: whether all maps have one scale already.
        threads: threads to search on.
        progress: told of each map.
    """
    if renumber and (align or fixed_scale):
        told = "--align" if align else "--fixed-scale"
        raise ValueError(f"--renumber is for maps of one world, {told} for others: choose one")
    check_outputs(inputs=check_inputs(inputs), maps=[output])
    first, *others = inputs
    merged = open_learning_map(first)
    result = Merged.begin(first, merged)

    def merge_one(path: Path) -> None:
        scene, found = open_learning_map(path), None
        before = len(merged)
        if renumber:
            _merge_renumbered(merged, scene)
        elif (
            found := find_alignment(
                merged,
                scene,
                align=align,
                fixed_scale=fixed_scale,
                threads=threads,
                hint=" (--renumber merges maps of one world that number their landmarks each on "
                "its own)",
            )
        ) is not None:
            _merge_aligned(merged, scene, found)
        else:
            _merge_texts(merged, scene)
            merged.merge_map(scene)
        result.note(path, scene, found, before + len(scene) - len(merged))

    merge_each(others, merge_one, progress)
    merged.save(output)
    result.facts |= {
        "kind": "learning map",
        "landmarks": len(merged),
        "dim": merged.dim,
        "appearance_bits": merged.appearance_bits or None,
        "bytes": output.stat().st_size,
    }
    return result


def merge_each(
    paths: Sequence[Path], merge_one: Callable[[Path], None], progress: Progress = silent
) -> None:
    """Merge maps in this order; those that cannot be are tried again after the others.

    Two maps that have nothing in common may both overlap with a third.

    Raises:
        ValueError: a map cannot be merged after all that can; the error names it.
    """
    waiting = list(paths)
    while waiting:
        failed: list[tuple[Path, ValueError]] = []
        for path in waiting:
            progress("merge", len(paths) - len(waiting), len(paths))
            try:
                merge_one(path)
            except ValueError as error:
                failed.append((path, error))
        if len(failed) == len(waiting):
            path, problem = failed[0]
            named = str(path) in str(problem)
            raise problem if named else ValueError(f"{path}: {problem}") from None
        waiting = [path for path, _ in failed]


def check_inputs(inputs: Sequence[Path]) -> list[Path]:
    """The map files of inputs to merge.

    Raises:
        ValueError: there are fewer than two, or one is named twice.
    """
    files = [map_path(path, learning=True) for path in inputs]
    if len(files) < 2:
        raise ValueError("name at least two maps to merge")
    resolved = [path.resolve() for path in files]
    for path, same in zip(inputs, resolved, strict=True):
        if resolved.count(same) > 1:
            raise ValueError(f"{path} is named twice, and its observations would count twice")
    return files


def find_alignment(
    merged: pm.PrototypeMap,
    scene: pm.PrototypeMap,
    *,
    align: bool = False,
    fixed_scale: bool = False,
    threads: int = 1,
    hint: str = "",
) -> Alignment | None:
    """How `scene` lies in the world of `merged`; None: in the same world, with the same ids.

    Maps with hardly any id in common are of one map, or of a job that numbers all landmarks; a
    warning says if they look otherwise. `align` says that they are not, whatever their ids. `hint`
    ends the sentence if a map is not recognized.

    Raises:
        ValueError: common ids are the same landmarks in other places, or different landmarks and
            nothing says how the maps lie in each other.
    """
    told = ""
    if not align:
        common = np.intersect1d(merged.ids, scene.ids, assume_unique=True)
        if len(common) < _MIN_COMMON:
            _warn_of_another_world(merged, scene, threads)
            return None
        if _same_landmarks(merged, scene, common):
            return None
        told = (
            f"{len(common):,} ids are in an earlier map, too, but stand for other landmarks there, "
            "and "
        )
    try:
        found = align_maps(merged, scene, fixed_scale, threads)
    except ValueError as error:
        problem = str(error)
    else:
        if not (problem := found.problem):
            return found
    raise ValueError(f"{told}it cannot be recognized in an earlier map: {problem}{hint}")


def _warn_of_another_world(merged: pm.PrototypeMap, scene: pm.PrototypeMap, threads: int) -> None:
    try:
        found = align_maps(merged, scene, threads=threads, searched=_PROBED)
    except ValueError:
        return
    if not (found.problem or found.stays):
        warnings.warn(
            f"{found.agreeing:,} landmarks of a map look like landmarks elsewhere in an earlier "
            "one, with other ids: the maps are merged as they are, in one world; if each has a "
            "world of its own, --align moves it",
            stacklevel=3,
        )


def _same_landmarks(merged: pm.PrototypeMap, scene: pm.PrototypeMap, common: Ids) -> bool:
    """Whether landmarks of one id look alike; ValueError if they do and lie elsewhere."""
    ours, theirs = merged.prototypes(common), scene.prototypes(common)
    others = np.roll(theirs, len(common) // 2, axis=0)
    same, different = (((ours - codes) ** 2).sum(axis=1) for codes in (theirs, others))
    if (same < different).mean() < _MIN_ALIKE:
        return False
    before, now = merged.positions(common), scene.positions(common)
    both = np.isfinite(before + now).all(axis=1)
    if both.sum() < _MIN_COMMON:
        return True
    shift, reach = (
        np.median(np.linalg.norm(before[both] - to, axis=1))
        for to in (now[both], np.median(before[both], axis=0))
    )
    if shift > _MAX_SHIFT * reach:
        raise ValueError(
            f"its landmarks have the ids of an earlier map and lie elsewhere ({shift:.3g} away, "
            "median): --align moves them there, if each map has a world of its own"
        )
    return True


def _merge_aligned(merged: pm.PrototypeMap, scene: pm.PrototypeMap, found: Alignment) -> None:
    ids = scene.ids
    shift = _first_free(merged, scene)
    into = ids + shift
    into[np.searchsorted(ids, found.source)] = found.into
    _merge_texts(merged, scene, shift)
    has_frame = "frame" in merged.metadata
    merged.merge_map(scene, into=into, source=ids)
    if not has_frame:  # the other map's describes the world that it leaves
        merged.metadata = {k: v for k, v in merged.metadata.items() if k != "frame"}
    new = ~np.isin(ids, found.source)
    merged.set_positions(into[new], found.similarity(scene.positions(ids[new])))


def _merge_renumbered(merged: pm.PrototypeMap, scene: pm.PrototypeMap) -> None:
    theirs, shift = scene.ids, _first_free(merged, scene)
    _merge_texts(merged, scene, shift)
    merged.merge_map(scene, into=theirs + shift, source=theirs)


def _first_free(merged: pm.PrototypeMap, scene: pm.PrototypeMap) -> int:
    """What to add to the ids of a map so that they are above those of another one."""
    existing, theirs = merged.ids, scene.ids
    first = int(existing[-1]) + 1 if len(existing) else 0
    if len(theirs) and int(theirs[-1]) > MAX_ID - first:
        raise ValueError(
            f"ids from {first} on leave no room for those up to {theirs[-1]}: use smaller ids"
        )
    return first


def _merge_texts(merged: pm.PrototypeMap, scene: pm.PrototypeMap, shift: int = 0) -> None:
    merged.metadata = merged.metadata | joint_origin(merged.metadata, scene.metadata, shift)
    if scene.metadata.get(cameras.KEY, "") not in ("", merged.metadata.get(cameras.KEY)):
        text = cameras.joint_cameras(merged, scene)
        merged.metadata = {**merged.metadata, cameras.KEY: text}
