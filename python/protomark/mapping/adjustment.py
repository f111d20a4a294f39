"""Bundle adjustment, local and global, by COLMAP and Ceres."""

from __future__ import annotations

from typing import Any

import numpy as np

from protomark.geometry.camera import Camera
from protomark.geometry.colmap import pycolmap, quiet
from protomark.geometry.triangulation import refine_points
from protomark.mapping.frame import Array, Ids
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
        reconstruction = _problem(structure, used)
        _solve(reconstruction, used, moving, fixed, iterations, loss_scale, intrinsics, threads)
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


def _problem(structure: Structure, seen: Observations) -> Any:
    """A pycolmap.Reconstruction of these observations; image ids are frame indices plus one."""
    reconstruction = pycolmap.Reconstruction()
    places = np.unique(seen.frames).tolist()
    for camera_id in sorted({structure.frames[i].camera_id for i in places}):
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera({**structure.cameras[camera_id].as_dict(), "camera_id": camera_id})
        )
    index = np.empty(len(seen.frames), np.int64)
    for i in places:
        frame, mine = structure.frames[i], np.flatnonzero(seen.frames == i)
        index[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=frame.name,
            camera_id=frame.camera_id,
            image_id=i + 1,
            keypoints=frame.keypoints[seen.rows[mine]].astype(np.float64),
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(frame.pose))
    # Access through the reconstruction takes longer than all else that an observation needs.
    images = {i + 1: reconstruction.images[i + 1] for i in places}
    order = np.argsort(seen.landmarks, kind="stable")
    ids, starts = np.unique(seen.landmarks[order], return_index=True)
    frames, index = (seen.frames[order] + 1).tolist(), index[order].tolist()
    ends = [*starts[1:].tolist(), len(frames)]
    for point, a, b in zip(ids.tolist(), starts.tolist(), ends, strict=True):
        track = pycolmap.Track([pycolmap.TrackElement(frames[k], index[k]) for k in range(a, b)])
        reconstruction.add_point3D_with_id(
            point, pycolmap.Point3D(xyz=structure.positions[point], track=track)
        )
        for k in range(a, b):
            images[frames[k]].set_point3D_for_point2D(index[k], point)
    return reconstruction


def _solve(
    reconstruction: Any,
    seen: Observations,
    moving: list[int],
    fixed: list[int],
    iterations: int,
    loss_scale: float,
    intrinsics: bool,
    threads: int,
) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = intrinsics
    options.refine_principal_point = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.function_tolerance = 1e-4
    config = pycolmap.BundleAdjustmentConfig()
    present = set(np.unique(seen.frames).tolist())
    for i in present:
        config.add_image(i + 1)
    held = [i for i in fixed if i in present]
    for i in held:
        config.set_constant_rig_from_world_pose(i + 1)
    if len(held) < 2:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment would write to the terminal.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    with quiet():
        adjuster.solve()


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
