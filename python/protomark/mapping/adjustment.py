"""Bundle adjustment, local and global, by COLMAP and Ceres."""

from __future__ import annotations

from typing import Any

import numpy as np

from protomark.geometry.camera import Camera
from protomark.geometry.colmap import bundle_adjust
from protomark.geometry.triangulation import refine_points
from protomark.mapping.frame import Array, Ids
from protomark.mapping.reconstruction import to_reconstruction
from protomark.mapping.structure import Observations, Structure

# The most-seen points of a frame take part in the adjustment; more cost time and do not lower the
# error. The others are refined afterwards, with the poses fixed.
_POINTS_PER_POSE = 250
# Keyframes outside of the neighbourhood that are held fixed, those that share most with it.
_MAX_FIXED = 15


def adjust_local(structure: Structure, newest: int, size: int, iterations: int) -> list[int]:
    """Adjust the keyframes that share most landmarks with one, and their landmarks.

    Args:
        structure: frames and landmarks; changed.
        newest: a keyframe, an index into `structure.frames`.
        size: number of keyframes that move.
        iterations: most steps of the solver.

    Returns:
        Indices of the frames that were moved.
    """
    shared = _shared(structure, np.unique(structure.frames[newest].seen))
    shared.pop(newest, None)
    near = sorted(shared, key=lambda i: (-shared[i], i))[: size - 1]
    moving = sorted([newest, *(i for i in near if shared[i] >= 10)])
    points = np.unique(np.concatenate([structure.frames[i].seen for i in moving]))
    holding = _shared(structure, points)
    others = sorted((i for i in holding if i not in moving), key=lambda i: (-holding[i], i))
    adjust(structure, moving, sorted(others[:_MAX_FIXED]), iterations=iterations)
    return moving


def adjust_global(
    structure: Structure,
    iterations: int = 30,
    loss_scale: float = 1.0,
    intrinsics: bool = False,
    poses: bool = True,
    threads: int = 1,
) -> None:
    """Adjust all keyframes and landmarks; with `intrinsics` the cameras, too."""
    keyframes = structure.keyframes()
    moving, fixed = (keyframes, []) if poses else ([], keyframes)
    adjust(structure, moving, fixed, iterations, loss_scale, intrinsics, threads)
    structure.recompute_views()


def _shared(structure: Structure, ids: Ids) -> dict[int, int]:
    """Number of the given landmarks that each keyframe sees, where it sees any."""
    wanted = np.zeros(len(structure.positions), bool)
    wanted[ids] = True
    frames, landmarks = structure.pairs(structure.keyframes())
    counts = np.bincount(frames[wanted[landmarks]], minlength=len(structure.frames))
    return {i: int(counts[i]) for i in np.flatnonzero(counts).tolist()}


def adjust(
    structure: Structure,
    moving: list[int],
    fixed: list[int],
    iterations: int,
    loss_scale: float = 1.0,
    intrinsics: bool = False,
    threads: int = 1,
) -> None:
    """Move frames and all landmarks that they see to the least (Cauchy) reprojection error.

    Args:
        structure: changed.
        moving: indices of keyframes that move.
        fixed: indices of keyframes that see the same landmarks and are held fixed.
        iterations: most steps of the solver.
        loss_scale: errors beyond so counts pixels count less.
        intrinsics: whether focal length and distortion move, too.
        threads: threads of the solver; their number changes the last digits.
    """
    seen = structure.observations(sorted({*moving, *fixed}))
    counts = np.bincount(seen.landmarks, minlength=len(structure.positions))
    seen = seen.where(counts[seen.landmarks] >= 2)
    if moving:
        used = seen.where(np.isin(seen.landmarks, _most_seen(seen, counts, set(moving))))
        before = {i: structure.frames[i].pose for i in moving}
        present = set(np.unique(used.frames).tolist())
        reconstruction = to_reconstruction(structure, sorted(present), used)
        bundle_adjust(
            reconstruction,
            [i + 1 for i in present],
            [i + 1 for i in fixed if i in present],
            iterations=iterations,
            loss_scale=loss_scale,
            intrinsics=intrinsics,
            threads=threads,
        )
        _read_back(structure, reconstruction, used, moving, intrinsics)
        _move_with_frames(structure, np.setdiff1d(seen.landmarks, used.landmarks), before)
    seen = structure.observations(sorted({*moving, *fixed}))
    seen = seen.where(counts[seen.landmarks] >= 2)
    structure.positions = refine_points(
        structure.positions, seen.landmarks, seen.poses, seen.rays, seen.focal
    )


def _most_seen(seen: Observations, counts: Ids, moving: set[int]) -> Ids:
    """The landmarks seen most often, enough for each frame."""
    order = np.argsort(seen.landmarks, kind="stable")
    ids, starts = np.unique(seen.landmarks[order], return_index=True)
    viewers = np.split(seen.frames[order], starts[1:])
    have: dict[int, int] = dict.fromkeys(np.unique(seen.frames).tolist(), 0)
    out = []
    for k in np.argsort(-counts[ids], kind="stable").tolist():
        frames = viewers[k].tolist()
        if any(have[i] < _POINTS_PER_POSE for i in frames if i in moving):
            out.append(ids[k])
            for i in frames:
                have[i] += 1
    return np.array(out, np.int64)


def _read_back(
    structure: Structure, reconstruction: Any, seen: Observations, moving: list[int], cameras: bool
) -> None:
    present = set(np.unique(seen.frames).tolist())
    for i in moving:
        if i in present:
            # In C order, as after loading: the memory layout decides the last digits of products.
            pose = np.ascontiguousarray(reconstruction.images[i + 1].cam_from_world().matrix())
            if np.isfinite(pose).all():
                structure.frames[i].pose = pose
    for point in np.unique(seen.landmarks).tolist():
        xyz = reconstruction.points3D[point].xyz
        if np.isfinite(xyz).all():
            structure.positions[point] = xyz
    if cameras:
        for camera_id, camera in reconstruction.cameras.items():
            params = tuple(float(p) for p in camera.params)
            if np.isfinite(params).all() and camera.mean_focal_length() > 0:
                ours = structure.cameras[camera_id]
                structure.set_camera(camera_id, Camera(ours.model, ours.width, ours.height, params))


def _move_with_frames(structure: Structure, ids: Ids, before: dict[int, Array]) -> None:
    """Move landmarks that took no part along with the first moved frame that sees them."""
    left = np.zeros(len(structure.positions), bool)
    left[ids] = True
    for i, old in before.items():
        frame = structure.frames[i]
        mine = frame.seen
        mine = mine[left[mine]]
        local = structure.positions[mine] @ old[:, :3].T + old[:, 3]
        structure.positions[mine] = (local - frame.pose[:, 3]) @ frame.pose[:, :3]
        left[mine] = False
