"""Merges maps with their frames: what `protomark merge` does with folders of `protomark map`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from protomark.files import SCENE_MAP, STATE, check_elsewhere, only_writer, replacing_folder
from protomark.geometry.similarity import Similarity
from protomark.mapping import adjustment
from protomark.mapping.mapper import LOOP_LOSS_SCALE, Mapper
from protomark.mapping.merging import merge_duplicates
from protomark.mapping.outputs import write_outputs
from protomark.mapping.prediction import MAX_STEP
from protomark.mapping.state import load_state, save_state
from protomark.mapping.structure import PER_LANDMARK
from protomark.maps.alignment import Alignment, Ids, align_maps
from protomark.maps.merge import Merged, check_inputs, find_alignment, merge_each
from protomark.progress import Progress, silent
from protomark.threads import one_blas_thread

# Maps meet in so many other places at most; there they are off by at most this share of the reach.
_MAX_LOOPS = 5
_MAX_DRIFT = 0.1


def merge_folders(
    inputs: Sequence[Path],
    output: Path,
    *,
    align: bool = False,
    fixed_scale: bool = False,
    seal: bool = True,
    threads: int = 1,
    progress: Progress = silent,
) -> Merged:
    """Merge maps with their frames, adjust all together, and write the folder of a map.

    Args:
        inputs: folders of `protomark map`; the world is that of the first, see `merge_each`.
        output: the folder to write, new or empty.
        align: each map has a world of its own, whatever the ids say.
        fixed_scale: whether all maps have one scale already.
        seal: whether to write a sealed map, too.
        threads: threads to search on.
        progress: told of each map.

    Raises:
        FileExistsError: the output holds files.
        FileError, ValueError: an input is no finished map of `protomark map`, or is not of the
            same place as those before it.
    """
    check_inputs(inputs)
    check_elsewhere(output)
    for path in inputs:
        if not (path / STATE).is_file():
            raise ValueError(
                f"{path} is no folder of a finished `protomark map`, whose frames can be merged: "
                "name a file to write, such as -o merged.pmk, to merge the landmarks alone"
            )
    with only_writer(output), one_blas_thread():
        if any(not path.name.startswith(".lock") for path in output.iterdir()):
            raise FileExistsError(f"{output} holds files: name a new folder with -o")
        first, *others = inputs
        mapper, facts = load_state(first, threads)
        result = Merged.begin(first, mapper.scene)
        inputs_of_frames: dict[str, str] = dict(facts.get("inputs", {}))

        def merge_one(path: Path) -> None:
            other, its = load_state(path, threads)
            if again := set(inputs_of_frames) & set(its.get("inputs", {})):
                raise ValueError(
                    f"its frames in {min(again)} are in an earlier map, too, and would count "
                    "twice: `protomark map` adds new images of a folder with --into"
                )
            found = find_alignment(
                mapper.scene, other.scene, align=align, fixed_scale=fixed_scale, threads=threads
            )
            if found is None:
                raise ValueError(
                    "its landmarks have the ids of an earlier map, or too few are common to both: "
                    "name a file to write, such as -o merged.pmk, to sum the maps; --align says "
                    "that each has a world of its own"
                )
            before = len(mapper.scene) + len(other.scene)
            result.note(path, other.scene, found, 0)
            prefix = insert_map(mapper, other, found, path.name)
            for name, old in its.get("inputs", {}).items():
                inputs_of_frames[name] = prefix + old
            result.facts["inputs"][-1]["in_common"] = before - len(mapper.scene)

        merge_each(others, merge_one, progress)
        mapper.history.begin_run()
        mapper.finish(progress=progress)
        progress("write", 0, 0)
        names = " + ".join(path.name for path in inputs)
        with replacing_folder(output.resolve()) as folder:
            figures = write_outputs(mapper, folder, names, finished=True, seal=seal)
            save_state(mapper, folder / STATE, {**facts, "inputs": inputs_of_frames})
    result.facts |= {**figures, "bytes": (output / SCENE_MAP).stat().st_size}
    return result


def insert_map(mapper: Mapper, other: Mapper, found: Alignment, name: str) -> str:
    """Insert frames and landmarks of another map; returns the prefix of its frames' names."""
    structure, motion = mapper.structure, found.similarity
    if mapper.options.fixed_poses and other.options.fixed_poses and found.stays:
        motion = Similarity(1.0, np.eye(3), np.zeros(3))  # all poses were given in one world
    shift, count = len(structure.positions), len(structure.frames)
    moved = other.structure
    moved.move(motion)
    moved.born += count
    structure.append(*(getattr(moved, array) for array in PER_LANDMARK))
    prefix = _prefix(mapper, other, name)
    first = 1 + MAX_STEP + max((f.index for f in structure.frames), default=-1)
    later = _time_shift(mapper, other)
    cameras = {i: _camera_id(mapper, camera) for i, camera in moved.cameras.items()}
    for frame in moved.frames:
        frame.index += first
        frame.name = prefix + frame.name
        frame.time += later
        frame.camera_id = cameras[frame.camera_id]
        frame.landmarks = np.where(frame.landmarks >= 0, frame.landmarks + shift, -1)
        camera = structure.cameras[frame.camera_id]
        frame.rays, frame.turns = camera.local_rays(frame.keypoints)
    structure.frames += moved.frames
    structure.recompute_views()
    for record in other.history.records.values():
        record = replace(record, name=prefix + record.name, index=record.index + first)
        mapper.history.records[record.name] = record
    ids = other.scene.ids
    mapper.scene.merge_map(other.scene, into=ids + shift, source=ids)
    merged = _merge_duplicates(mapper, found.into, found.source + shift)
    merged += _close_loops(mapper, count)
    mapper.history.events += [
        *(f"{name}: {event}" for event in other.history.events),
        f"{name}: merged by {found.agreeing} landmarks that agree, {merged} duplicates",
    ]
    return prefix


def _merge_duplicates(mapper: Mapper, into: Ids, source: Ids) -> int:
    """Merge landmarks that are one, and adjust all; returns their number."""
    structure = mapper.structure
    pairs = list(zip(into.tolist(), source.tolist(), strict=True))
    merged = merge_duplicates(structure, mapper.memory, pairs, check=False)
    if not mapper.options.fixed_poses:
        adjustment.adjust_global_bundle(structure, 20, loss_scale=LOOP_LOSS_SCALE)
    return merged


def _close_loops(mapper: Mapper, count: int) -> int:
    """Merge landmarks that only the first `count` frames see with those of the others, elsewhere.

    Where two maps meet a second time, drift has kept their landmarks apart.
    """
    structure, scene, merged = mapper.structure, mapper.scene, 0
    for _ in range(_MAX_LOOPS):
        frames, landmarks = structure.pairs()
        scene.set_positions(structure.ids, structure.positions[structure.ids])
        first, second = (np.unique(landmarks[s]) for s in (frames < count, frames >= count))
        alone = (np.setdiff1d(first, second), np.setdiff1d(second, first))
        try:
            found = align_maps(scene.part(alone[0]), scene.part(alone[1]))
        except ValueError:
            break
        # That the maps are of one scene is known: little in common is enough.
        if not found.is_significant or found.drift > _MAX_DRIFT * found.reach:
            break
        merged += _merge_duplicates(mapper, found.into, found.source)
    return merged


def _prefix(mapper: Mapper, other: Mapper, name: str) -> str:
    """A prefix for the names of frames that differ from those in the map; "" if they do."""
    records = mapper.history.records
    prefixes = ["", f"{name}/", *(f"{name}-{i}/" for i in range(2, 1000))]
    return next(p for p in prefixes if all(p + r not in records for r in other.history.records))


def _time_shift(mapper: Mapper, other: Mapper) -> float:
    """What to add to times so that those of two maps do not mix, unless both have seconds."""
    old, new = ([frame.time for frame in m.structure.frames] for m in (mapper, other))
    if not (old and new) or min(new) > max(old) or max(new) < min(old):
        return 0.0
    if set(new).isdisjoint(old) and any(time % 1 for time in (*old, *new)):
        return 0.0
    return math.ceil(1 + max(old) - min(new))


def _camera_id(mapper: Mapper, camera: Any) -> int:
    """The id of a camera that this one resembles, so that they are adjusted as one, or a new id."""
    cameras = mapper.structure.cameras
    known = (i for i, other in cameras.items() if other.resembles(camera))
    return next(known, None) or mapper.id_of_camera(camera)
