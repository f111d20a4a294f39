"""Bundle adjustment, local and global, by COLMAP and Ceres."""

from __future__ import annotations

from typing import Any

import numpy as np

from protomark.geometry.camera import Camera
from protomark.geometry.colmap import bundle_adjust
from protomark.geometry.pose import transform
from protomark.geometry.triangulation import refine_points
from protomark.mapping.frame import Array, Ids
from protomark.mapping.reconstruction import to_reconstruction
from protomark.mapping.self_calibration import Calibration
from protomark.mapping.structure import Observations, Structure

# Each frame's most observed landmarks take part in the adjustment; more cost time and do not lower
# the error. The others are refined afterwards, under fixed poses.
_POINTS_PER_POSE = 250
# Of the keyframes around those that move, the ones that share most landmarks are held fixed.
_MAX_FIXED = 15


def adjust_local_bundle(structure: Structure, newest: int, size: int, iterations: int) -> list[int]:
    """Adjust `size` keyframes, those that share most landmarks with the newest; returns them."""
    shared = _shared(structure, np.unique(structure.frames[newest].seen))
    shared.pop(newest, None)
    near = sorted(shared, key=lambda i: (-shared[i], i))[: size - 1]
    moving = sorted([newest, *(i for i in near if shared[i] >= 10)])
    points = np.unique(np.concatenate([structure.frames[i].seen for i in moving]))
    shared = _shared(structure, points)
    others = sorted((i for i in shared if i not in moving), key=lambda i: (-shared[i], i))
    adjust(structure, moving, sorted(others[:_MAX_FIXED]), iterations=iterations)
    return moving


def adjust_global_bundle(
    structure: Structure,
    iterations: int = 30,
    loss_scale: float = 1.0,
    calibration: Calibration | None = None,  # None: cameras stay as they are
    poses: bool = True,  # whether they move
    threads: int = 1,
) -> None:
    """Adjust all keyframes and landmarks."""
    keyframes = structure.keyframes()
    moving, fixed = (keyframes, []) if poses else ([], keyframes)
    adjust(structure, moving, fixed, iterations, loss_scale, calibration, threads)
    structure.recompute_views()


def _shared(structure: Structure, ids: Ids) -> dict[int, int]:
    """How many of these landmarks each keyframe observes; those that observe any."""
    chosen = np.zeros(len(structure.positions), bool)
    chosen[ids] = True
    frames, landmarks = structure.pairs(structure.keyframes())
    counts = np.bincount(frames[chosen[landmarks]], minlength=len(structure.frames))
    return {i: int(counts[i]) for i in np.flatnonzero(counts).tolist()}


def adjust(
    structure: Structure,
    moving: list[int],
    fixed: list[int],  # keyframes that observe the same landmarks
    iterations: int,
    loss_scale: float = 1.0,
    calibration: Calibration | None = None,  # None: cameras stay as they are
    threads: int = 1,
) -> None:
    """Move frames and the landmarks they observe to the least (Cauchy) reprojection error."""
    pixel = max(map(structure.pixel, structure.cameras))
    seen = structure.observations(sorted({*moving, *fixed}))
    counts = np.bincount(seen.landmarks, minlength=len(structure.positions))
    seen = seen.where(counts[seen.landmarks] >= 2)
    if moving:
        used = seen.where(np.isin(seen.landmarks, _most_observed(seen, counts, set(moving))))
        before = {i: structure.frames[i].pose for i in moving}
        present = sorted(np.unique(used.frames).tolist())
        for intrinsics in (True, False) if calibration is not None else (False,):
            reconstruction = to_reconstruction(structure, present, used)
            images = [i + 1 for i in present]
            bundle_adjust(
                reconstruction,
                images,
                [i + 1 for i in fixed if i in present],
                iterations=iterations,
                loss_scale=loss_scale * pixel,
                intrinsics=intrinsics,
                threads=threads,
            )
            if calibration is None or not intrinsics or calibration.accept(reconstruction, images):
                break
        _read_back(structure, reconstruction, used, moving, intrinsics)
        _move_with_frames(structure, np.setdiff1d(seen.landmarks, used.landmarks), before)
    seen = structure.observations(sorted({*moving, *fixed}))
    seen = seen.where(counts[seen.landmarks] >= 2)
    structure.positions = refine_points(
        structure.positions, seen.landmarks, seen.poses, seen.rays, seen.focal, huber=pixel
    )


def _most_observed(seen: Observations, counts: Ids, moving: set[int]) -> Ids:
    """The landmarks with the most observations, `_POINTS_PER_POSE` for each moving frame."""
    order = np.argsort(seen.landmarks, kind="stable")
    ids, starts = np.unique(seen.landmarks[order], return_index=True)
    observers = np.split(seen.frames[order], starts[1:])
    chosen_per_frame: dict[int, int] = dict.fromkeys(np.unique(seen.frames).tolist(), 0)
    chosen = []
    for k in np.argsort(-counts[ids], kind="stable").tolist():
        frames = observers[k].tolist()
        if any(chosen_per_frame[i] < _POINTS_PER_POSE for i in frames if i in moving):
            chosen.append(ids[k])
            for i in frames:
                chosen_per_frame[i] += 1
    return np.array(chosen, np.int64)


def _read_back(
    structure: Structure, reconstruction: Any, seen: Observations, moving: list[int], cameras: bool
) -> None:
    present = set(np.unique(seen.frames).tolist())
    for i in moving:
        if i in present:
            # In C order, as after loading: memory layout decides the last digits of products.
            pose = np.ascontiguousarray(reconstruction.images[i + 1].cam_from_world().matrix())
            if np.isfinite(pose).all():
                structure.frames[i].pose = pose
    for point in np.unique(seen.landmarks).tolist():
        xyz = reconstruction.points3D[point].xyz
        if np.isfinite(xyz).all():
            structure.positions[point] = xyz
    if cameras:
        for camera_id, camera in reconstruction.cameras.items():
            structure.set_camera(camera_id, Camera.from_colmap(camera))


def _move_with_frames(structure: Structure, ids: Ids, before: dict[int, Array]) -> None:
    """Move landmarks that took no part along with the first moved frame that observes them."""
    remaining = np.zeros(len(structure.positions), bool)
    remaining[ids] = True
    for i, old in before.items():
        frame = structure.frames[i]
        moved = frame.seen[remaining[frame.seen]]
        local = transform(old, structure.positions[moved])
        structure.positions[moved] = (local - frame.pose[:, 3]) @ frame.pose[:, :3]
        remaining[moved] = False
