"""Checks what a map counts as registered, and says what in it cannot be trusted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from protomark.geometry.absolute_pose import free_lens, pose_covariance
from protomark.geometry.neighbours import runs
from protomark.geometry.pose import camera_centers, transform
from protomark.mapping.adjustment import free_focal_lengths
from protomark.mapping.frame import Array, Frame
from protomark.mapping.history import REGISTERED
from protomark.mapping.initialisation import MIN_PARALLAX
from protomark.mapping.prediction import MAX_STEP
from protomark.mapping.structure import Structure
from protomark.mapping.tracking import LandmarkMatches, Tracker

if TYPE_CHECKING:
    from protomark.mapping.mapper import Mapper
    from protomark.mapping.source import FrameSource

# The standard deviation of a camera's centre may be this share of the median depth that it sees.
_MAX_DEVIATION = 0.03
# A frame needs this many landmarks after all culling.
_MIN_LANDMARKS = 10
# A camera was thrown if it moves so many times as far from one frame to the next as in the median,
# and so many times as far as what it sees is away.
_MAX_STEP_RATIO = 20.0
_MAX_STEP_DEPTHS = 3.0
_MIN_STEPS = 8
# Connections are judged where at least this many keyframes lie on either side.
_MIN_SIDE = 3
_MAX_NAMED = 3
# A given camera is wrong if another focal length fits better that is this share of it away, and so
# many standard deviations.
_MAX_OFF, _MAX_SIGMAS = 0.05, 5.0
# A frame is of another lens if it fits a focal length that is this share longer or shorter than
# most frames fit, and so many standard deviations: its own, and that of most frames.
_MAX_STRETCH, _STRETCH_SIGMAS, _MOST_SIGMAS = 0.04, 3.0, 5.0
# A given pose is wrong if it is this share of the longer side off in the image (median). A map is
# not extended if that share of the new frames contradict their given poses.
_MAX_OFFSET = 0.05
_MAX_ELSEWHERE = 0.1
# Maps with a smaller share of their frames are of something else than their input.
_MIN_REGISTERED = 0.5

NOT_FOUND = "not found in the map: too few matches agree on a pose"
UNCERTAIN = "its pose is uncertain: what it sees has too little depth, or lies too close together"
THROWN = "it was thrown far away from its neighbours"
WAITING = "before the first pair of frames with enough parallax"
ELSEWHERE = "the map shows that it was taken elsewhere than its given pose says"
TOO_FEW = "too few landmarks are left that it observes"


def is_uncertain(structure: Structure, frame: Frame, pose: Array, matches: LandmarkMatches) -> bool:
    """Whether landmarks that match leave open where a frame was taken."""
    matched = structure.matched(frame, matches.rows, matches.ids)
    covariance = pose_covariance(pose, *matched)
    if covariance is None:
        return True
    depth = float(np.median(np.abs(transform(pose, matched[1])[:, 2])))
    return bool(np.sqrt(np.trace(covariance[3:, 3:])) > _MAX_DEVIATION * depth)


def taken_elsewhere(tracker: Tracker, frame: Frame, pose: Array) -> bool:
    """Whether a frame is found in the map, but far from its given pose."""
    found, structure = tracker.relocalize(frame), tracker.structure
    if found is None:
        return False
    off = structure.median_error(pose, frame, found.matches.rows, found.matches.ids)
    return off > structure.tolerance(frame.camera_id, _MAX_OFFSET)


def are_elsewhere(mapper: Mapper, source: FrameSource) -> bool:
    """Whether the map contradicts the given poses of too many of its new frames."""
    records = [r for r in mapper.history.records.values() if r.index >= source.first_index]
    return sum(r.outcome == ELSEWHERE for r in records) > _MAX_ELSEWHERE * len(records)


def untrusted_frames(structure: Structure) -> dict[int, str]:
    """Indices of the frames whose poses fail the checks, and why."""
    failed: dict[int, str] = {}
    for i, frame in enumerate(structure.frames):
        if len(frame.seen) < _MIN_LANDMARKS:
            failed[i] = TOO_FEW
        elif is_uncertain(
            structure, frame, frame.pose, LandmarkMatches(frame.observed, frame.seen)
        ):
            failed[i] = UNCERTAIN
    for camera_id in {frame.camera_id for frame in structure.frames}:
        order = [
            i
            for i, frame in enumerate(structure.frames)
            if frame.camera_id == camera_id and i not in failed
        ]
        order.sort(key=lambda i: structure.frames[i].index)
        failed |= dict.fromkeys(_thrown(structure, order), THROWN)
    return failed


def _thrown(structure: Structure, order: Sequence[int]) -> list[int]:
    """Frames of a sequence that lie too far from the longest part without a jump."""
    frames = [structure.frames[i] for i in order]
    if len(frames) <= _MIN_STEPS:
        return []
    centers = camera_centers(np.array([frame.pose for frame in frames]))
    indices = np.array([frame.index for frame in frames])
    depths = np.array(
        [np.median(np.abs(transform(f.pose, structure.positions[f.seen])[:, 2])) for f in frames]
    )
    gaps = np.minimum(np.diff(indices), MAX_STEP)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1) / gaps
    limit = _MAX_STEP_RATIO * float(np.median(steps))

    def jumps(one: int, other: int) -> bool:
        distance = float(np.linalg.norm(centers[one] - centers[other]))
        steps = max(abs(int(indices[one] - indices[other])), 1)
        return distance > limit * steps and distance > _MAX_STEP_DEPTHS * min(
            depths[one], depths[other]
        )

    cuts = [k + 1 for k in range(len(frames) - 1) if jumps(k, k + 1)]
    parts = list(zip([0, *cuts], [*cuts, len(frames)], strict=True))
    start, end = max(parts, key=lambda part: part[1] - part[0])
    thrown = []
    for outward in (range(start - 1, -1, -1), range(end, len(frames))):
        last = start if outward.step < 0 else end - 1
        for k in outward:
            if jumps(last, k):
                thrown.append(order[k])
            else:
                last = k
    return thrown


def weak_connections(structure: Structure, min_landmarks: int) -> list[str]:
    """Names of keyframes before which too few landmarks carry the scale of the map on.

    These are landmarks that at least two keyframes on either side observe, so that both sides know
    how far away they are. Where there are fewer than the matches of a pose, two parts fit together
    at many scales.
    """
    frames = structure.frames
    order = sorted(structure.keyframes(), key=lambda i: (frames[i].camera_id, frames[i].index))
    place = np.zeros(len(frames), np.int64)
    place[order] = np.arange(len(order))
    indices, landmarks = structure.pairs(order)
    by_landmark = np.lexsort((place[indices], landmarks))
    places = place[indices[by_landmark]]
    starts, lengths = runs(landmarks[by_landmark])
    starts, lengths = starts[lengths >= 4], lengths[lengths >= 4]
    first, last = places[starts + 1], places[starts + lengths - 2]
    changes = np.bincount(first + 1, minlength=len(order) + 1)
    changes -= np.bincount(last + 1, minlength=len(order) + 1)
    # Near both ends a side has too few keyframes.
    carried = np.cumsum(changes)[_MIN_SIDE : len(order) + 1 - _MIN_SIDE]
    weak = _MIN_SIDE + np.flatnonzero(carried < min_landmarks)
    # A gap without enough landmarks counts once, in the middle of where there are fewest.
    names = []
    for a, n in zip(*runs(weak - np.arange(len(weak))), strict=True):
        gap = weak[a : a + n]
        fewest = gap[carried[gap - _MIN_SIDE] == carried[gap - _MIN_SIDE].min()]
        names.append(frames[order[fewest[len(fewest) // 2]]].name)
    return names


def wrong_focal_lengths(structure: Structure) -> list[str]:
    """Sentences on given cameras that the images contradict."""
    out = []
    for i, (focal, deviation) in free_focal_lengths(structure).items():
        given = structure.cameras[i].focal_length
        off = abs(focal / given - 1)
        if off > max(_MAX_OFF, _MAX_SIGMAS * deviation):
            out.append(
                f"the camera has a focal length of {given:.0f} pixels, but {focal:.0f} fit the "
                "images better: check --camera, or leave it out"
            )
    return out


def other_lenses(structure: Structure) -> list[str]:
    """Names of frames that fit another focal length than most: a zoom, another camera."""
    found: dict[int, list[tuple[str, float, float]]] = {}
    for frame in structure.frames:
        camera, rows = structure.cameras[frame.camera_id], frame.observed
        if camera.wide or len(rows) < _MIN_LANDMARKS:
            continue
        matched = structure.matched(frame, rows, frame.seen)
        free = free_lens(frame.pose, *matched, structure.max_error(frame.camera_id))
        one = frame.name, float(np.log(free.stretch)), free.deviation
        found.setdefault(frame.camera_id, []).append(one)
    names: list[str] = []
    for frames in found.values():
        middle, spread = _shortest_half([stretch for _, stretch, _ in frames])
        limit = max(_MAX_STRETCH, _MOST_SIGMAS * spread)
        names += [
            name
            for name, stretch, deviation in frames
            if abs(stretch - middle) > max(limit, _STRETCH_SIGMAS * deviation)
        ]
    return names


def _shortest_half(values: Sequence[float]) -> tuple[float, float]:
    """Median and standard deviation of most values, by the shortest interval with half of them.

    Rousseeuw and Leroy, A Robust Scale Estimator Based on the Shortest Half, 1988.
    """
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    lengths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    first = int(np.argmin(lengths))
    # Half of all normal numbers lie within 0.67 standard deviations.
    return float(np.median(ordered[first : first + half])), float(lengths[first] / (2 * 0.6745))


def warnings(mapper: Mapper) -> list[str]:
    """Sentences on what in a map cannot be trusted; none if it can."""
    out = []
    calibration, camera = mapper.calibration, mapper.camera
    if calibration is not None and not calibration.determined and not calibration.given:
        span = [round(f) for f in sorted([camera.focal_length, *calibration.others])]
        others = f", but {span[0]} to {span[-1]} fit as well" if calibration.others else ""
        out.append(
            f"the images do not determine the focal length, it stays at {camera.focal_length:.0f} "
            f"pixels{others}: give the camera with --camera or its focal length with --focal, or "
            "add images that turn and that come closer"
        )
    if calibration is None and not mapper.options.fixed_poses:
        out += wrong_focal_lengths(mapper.structure)
    records = list(mapper.history.records.values())
    registered = sum(record.outcome == REGISTERED for record in records)
    if registered < _MIN_REGISTERED * len(records):
        out.append(
            f"only {registered} of {len(records)} frames are registered: check that the images "
            "overlap and show one scene, and give the camera with --camera"
        )
    seen = len(mapper.structure.pairs()[0])
    if mapper.options.fixed_poses and seen < mapper.options.min_inliers * registered:
        out.append(
            f"the frames observe {seen / max(registered, 1):.0f} landmarks each: the poses do not "
            "fit the images, or --camera is wrong"
        )
    thrown = sum(record.outcome == THROWN for record in records)
    if thrown:
        out.append(
            f"parts of the map flew away, and {thrown} frames were taken out with them: what "
            "connects these parts has too little depth or overlap"
        )
    zoomed = other_lenses(mapper.structure)
    if zoomed and not mapper.options.fixed_poses:
        out.append(
            f"{len(zoomed)} frames, such as {zoomed[0]}, fit better with another focal length: was "
            "another lens or zoom used? Give each image its camera, or map them apart"
        )
    weak = weak_connections(mapper.structure, mapper.options.min_inliers)
    if weak and not mapper.options.fixed_poses:
        out.append(
            f"the map may change its scale before {', '.join(weak[:_MAX_NAMED])}"
            f"{', ...' if len(weak) > _MAX_NAMED else ''}: fewer than {mapper.options.min_inliers} "
            "landmarks connect what comes before and after: add frames in between"
        )
    return out


def no_map(mapper: Mapper, source: FrameSource, known: int = 0) -> str:
    """Why there is no map, or why a map with `known` frames was not extended."""
    records = [r for r in mapper.history.records.values() if r.outcome != REGISTERED]
    common = Counter(r.outcome for r in records).most_common(1)
    if known and are_elsewhere(mapper, source):
        return (
            f"{source.path}: the map stays as it was, as these poses are not in its world: "
            "--poses must have its origin, axes and scale"
        )
    if known:
        return (
            f"{source.path}: none of its frames fits the map, which stays as it was: "
            f"{common[0][0] if common else 'there is no new one'}"
        )
    if common and common[0][0] != WAITING:
        return (
            f"{source.path}: no map: of {len(mapper.history.records)} frames {common[0][1]} have "
            f"this in common: {common[0][0]}"
        )
    if len(records) < 2:
        return f"{source.path}: no map: one image shows no depth, give several"
    parallax = mapper.initialiser.best_parallax
    if parallax >= MIN_PARALLAX:
        return (
            f"{source.path}: no map: frames are taken far enough apart, but no pair of them fits "
            "what the others see: check --camera, and that nothing but the camera moves"
        )
    best = math.floor(10 * parallax) / 10
    return (
        f"{source.path}: no map: no two of {len(records)} frames overlap enough and are taken far "
        f"enough apart (the best pair has {best:.1f} degrees of parallax, {MIN_PARALLAX:g} are "
        "needed): move the camera sideways, or check that frames overlap and --camera is right"
    )
