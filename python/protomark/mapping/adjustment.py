"""Bundle adjustment of a map, local and global."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.bundle import Bundle
from protomark.geometry.camera import Camera
from protomark.mapping.frame import Ids
from protomark.mapping.self_calibration import CALIBRATED_MODEL, Calibration
from protomark.mapping.structure import Observations, Structure

# Of the keyframes around those that move, the ones that share most landmarks are held fixed.
_MAX_FIXED = 15
# Steps that show whether other focal lengths fit better.
_FREE_STEPS = 30
# The images leave the focal length open if one that is by this factor longer or shorter has at most
# so many times the loss: on a straight road 1.000 times, elsewhere 1.014 times and more.
_OTHER, _AS_GOOD = 1.2, 1.01
# So many landmarks and steps are enough to tell.
_SAMPLED, _STEPS = 2500, 15


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
) -> None:
    """Adjust all keyframes but the first, and all landmarks."""
    keyframes = structure.keyframes()
    moving = keyframes[1:] if poses else []
    adjust(structure, moving, keyframes, iterations, loss_scale, calibration)
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
) -> None:
    """Move frames and the landmarks they observe to the least (Cauchy) reprojection error."""
    seen = structure.observations(sorted({*moving, *fixed}))
    moves = np.zeros(len(structure.frames), bool)
    moves[moving] = True
    size = len(structure.positions)
    chosen = np.bincount(seen.landmarks, minlength=size) >= 2
    if moving:
        chosen &= np.bincount(seen.landmarks, moves[seen.frames], minlength=size) > 0
    seen = seen.where(chosen[seen.landmarks])
    if not len(seen.frames):
        return
    bundle = _bundle(structure, seen, moves, calibration is not None)
    bundle.adjust(iterations, loss_scale)
    if calibration is not None:
        cameras = _calibrated(structure, seen, bundle)
        if calibration.accept(list(cameras.values()), float(bundle.focal_deviations().max())):
            for i, camera in cameras.items():
                structure.set_camera(i, camera)
        else:
            bundle = _bundle(structure, seen, moves, False)
            bundle.adjust(iterations, loss_scale)
    for i, pose in zip(np.unique(seen.frames).tolist(), bundle.poses, strict=True):
        if moves[i] and np.isfinite(pose).all():
            structure.frames[i].pose = pose
    finite = np.isfinite(bundle.points).all(1)
    structure.positions[np.unique(seen.landmarks)[finite]] = bundle.points[finite]


def free_focal_lengths(structure: Structure) -> dict[int, tuple[float, float]]:
    """Focal lengths that fit best, and their relative deviations, by camera; the map stays."""
    whole = _whole(structure, False)
    if whole is None or any(camera.wide for camera in structure.cameras.values()):
        return {}
    seen, bundle = whole
    bundle = replace(bundle, refined=np.ones_like(bundle.refined))
    bundle.adjust(_FREE_STEPS)
    found = zip(bundle.lenses[:, 0].tolist(), bundle.focal_deviations().tolist(), strict=True)
    return dict(zip(_camera_ids(structure, seen), found, strict=True))


def other_factors(structure: Structure) -> list[float]:
    """Factors of the calibrated focal lengths that fit the images as well; the map stays."""
    whole = _whole(structure, True, _SAMPLED)
    if whole is None or not whole[1].refined.any():
        return []
    _, bundle = whole

    def loss(factor: float) -> float:
        lenses = np.where(bundle.refined, bundle.lenses * [factor, 1], bundle.lenses)
        other = replace(bundle, lenses=lenses, refined=bundle.refined & [False, True])
        return other.adjust(_STEPS)

    limit = _AS_GOOD * loss(1.0)
    return [factor for factor in (1 / _OTHER, _OTHER) if loss(factor) <= limit]


def _whole(
    structure: Structure, calibrate: bool, limit: int = 10**9
) -> tuple[Observations, Bundle] | None:
    """What all keyframes, all but the first moving, observe of at most `limit` landmarks."""
    keyframes = structure.keyframes()
    seen = structure.observations(keyframes)
    ids = np.flatnonzero(structure.counts() >= 2)
    seen = seen.where(np.isin(seen.landmarks, ids[:: 1 + len(ids) // limit]))
    if not len(seen.frames):
        return None
    moves = np.zeros(len(structure.frames), bool)
    moves[keyframes[1:]] = True
    return seen, _bundle(structure, seen, moves, calibrate)


def _camera_ids(structure: Structure, seen: Observations) -> list[int]:
    return sorted({structure.frames[i].camera_id for i in np.unique(seen.frames).tolist()})


def _bundle(
    structure: Structure, seen: Observations, moves: NDArray[np.bool_], calibrate: bool
) -> Bundle:
    """The frames, landmarks and cameras of observations, each in ascending order."""
    frames, frame = np.unique(seen.frames, return_inverse=True)
    ids, point = np.unique(seen.landmarks, return_inverse=True)
    cameras = _camera_ids(structure, seen)
    camera = np.array([cameras.index(structure.frames[i].camera_id) for i in frames.tolist()])
    models = [structure.cameras[i] for i in cameras]
    refined = np.array([[calibrate and one.model == CALIBRATED_MODEL] * 2 for one in models])
    distortions = [c.params[3] if r else 0.0 for c, r in zip(models, refined[:, 1], strict=True)]
    lenses = np.column_stack([[c.focal_length for c in models], distortions])
    focal, distortion = lenses[camera[frame]].T
    stretch = focal * (1 + distortion * (seen.rays * seen.rays).sum(1))
    poses = np.array([structure.frames[i].pose for i in frames.tolist()])
    turns = None
    if any(one.wide for one in models):
        turns = seen.poses[:, :, :3] @ poses[frame, :, :3].transpose(0, 2, 1)
    return Bundle(
        poses,
        moves[frames],
        camera,
        lenses,
        refined,
        structure.positions[ids],
        frame,
        point,
        stretch[:, None] * seen.rays,
        seen.sigma,
        turns,
    )


def _calibrated(structure: Structure, seen: Observations, bundle: Bundle) -> dict[int, Camera]:
    """The cameras that an adjustment refined."""
    out = {}
    for k, i in enumerate(_camera_ids(structure, seen)):
        if bundle.refined[k].all():
            old, (focal, distortion) = structure.cameras[i], bundle.lenses[k].tolist()
            out[i] = replace(old, params=(focal, *old.params[1:3], distortion))
    return out
