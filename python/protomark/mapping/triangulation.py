"""New landmarks from the descriptors that the window still keeps."""

from __future__ import annotations

import numpy as np

from protomark.mapping.memory import Memory
from protomark.mapping.structure import Frame, Ids, Structure
from protomark.tracks.geometry import depth_of_first, refine_points, relative_pose, residuals
from protomark.tracks.matching import View, match

RATIO = 0.8


def triangulate(
    structure: Structure,
    memory: Memory,
    newest: int,
    window: list[int],
    max_error: float,
    min_angle: float,
) -> list[tuple[int, int]]:
    """Match a frame with those of the window, make landmarks, and lengthen those there are.

    Exact Hamming search, ratio test, mutual, near the epipolar line; then landmarks of two rays
    whose angle is wide enough and that project back to where they were seen. Where one of the two
    keypoints sees a landmark already, the other one joins it if it projects there.

    Args:
        structure: frames and landmarks.
        memory: gets every new observation.
        newest: the frame, a place in `structure.frames`; it has its descriptors.
        window: other frames that still have theirs.
        max_error: largest reprojection error, as a share of the image's longer side.
        min_angle: smallest angle between the two rays, degrees.

    Returns:
        Pairs of landmarks that a match says are one.
    """
    frame = structure.frames[newest]
    same: list[tuple[int, int]] = []
    for place in sorted(window):
        same += _pair(structure, memory, structure.frames[place], frame, max_error, min_angle)
    return same


def _pair(
    structure: Structure,
    memory: Memory,
    old: Frame,
    new: Frame,
    max_error: float,
    min_angle: float,
) -> list[tuple[int, int]]:
    views = [_view(structure, frame) for frame in (old, new)]
    limit = structure.tolerance(new.camera_id, max_error)
    rows = match(views[0], views[1], RATIO, limit).rows
    a, b = rows[:, 0], rows[:, 1]
    known_a, known_b = old.landmarks[a], new.landmarks[b]
    fresh = (known_a < 0) & (known_b < 0)
    _create(structure, memory, old, new, a[fresh], b[fresh], max_error, min_angle)
    only_a, only_b = (known_a >= 0) & (known_b < 0), (known_a < 0) & (known_b >= 0)
    _join(structure, memory, new, b[only_a], known_a[only_a], limit)
    _join(structure, memory, old, a[only_b], known_b[only_b], limit)
    both = (known_a >= 0) & (known_b >= 0) & (known_a != known_b)
    return list(zip(known_a[both].tolist(), known_b[both].tolist(), strict=True))


def _view(structure: Structure, frame: Frame) -> View:
    if frame.descriptors is None:
        raise ValueError(f"{frame.name}: its descriptors are gone, it has left the window")
    return View(frame.descriptors, frame.rays, frame.pose, structure.focal(frame.camera_id))


def _create(
    structure: Structure,
    memory: Memory,
    old: Frame,
    new: Frame,
    a: Ids,
    b: Ids,
    max_error: float,
    min_angle: float,
) -> None:
    if not len(a):
        return
    rotation, translation = relative_pose(old.pose, new.pose)
    depth, angle = depth_of_first(rotation, translation, old.rays[a], new.rays[b])
    wide = (depth > 0) & (angle > np.radians(min_angle))
    a, b, depth = a[wide], b[wide], depth[wide]
    local = np.column_stack([old.rays[a], np.ones(len(a))]) * depth[:, None]
    points = (local - old.pose[:, 3]) @ old.pose[:, :3]
    many = len(points)
    poses = np.repeat(np.stack([old.pose, new.pose]), many, axis=0)
    seen = np.concatenate([old.rays[a], new.rays[b]])
    focal = np.repeat([structure.focal(f.camera_id) for f in (old, new)], many)
    points = refine_points(points, np.tile(np.arange(many), 2), poses, seen, focal, iterations=2)
    difference, depth = residuals(np.tile(points, (2, 1)), poses, seen)
    error = np.linalg.norm(difference, axis=1) * focal
    limits = np.repeat([structure.tolerance(f.camera_id, max_error) for f in (old, new)], many)
    fits = ((error <= limits) & (depth > 0)).reshape(2, many).all(0)
    a, b = a[fits], b[fits]
    ids = structure.create(points[fits])
    for frame, rows in ((old, a), (new, b)):
        structure.observe(frame, rows, ids)
        remember(memory, frame, rows)


def _join(
    structure: Structure, memory: Memory, frame: Frame, rows: Ids, ids: Ids, limit: float
) -> None:
    """Let keypoints see landmarks that project to them and that the frame does not see yet."""
    if not len(rows):
        return
    difference, depth = residuals(
        structure.positions[ids], np.repeat(frame.pose[None], len(ids), axis=0), frame.rays[rows]
    )
    error = np.linalg.norm(difference, axis=1) * structure.focal(frame.camera_id)
    # Landmarks may have been made, and keypoints taken, since the match.
    fits = (depth > 0) & (error <= limit) & (frame.landmarks[rows] < 0)
    fits &= ~np.isin(ids, frame.seen)
    rows, ids = rows[fits], ids[fits]
    _, first = np.unique(ids, return_index=True)
    rows, ids = rows[first], ids[first]
    structure.observe(frame, rows, ids)
    remember(memory, frame, rows)


def remember(memory: Memory, frame: Frame, rows: Ids) -> None:
    """Add what keypoints of a frame look like to the landmarks that they see."""
    if len(rows) and frame.encoded is not None:
        memory.add(frame.landmarks[rows], frame.encoded[rows])
