"""Triangulates landmarks from the descriptors of the window."""

from __future__ import annotations

import numpy as np

from protomark.geometry.pose import relative_pose
from protomark.geometry.triangulation import depth_of_first, pixel_errors, refine_points
from protomark.mapping.frame import Frame, Ids
from protomark.mapping.initialisation import RATIO
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Structure
from protomark.tracks.matching import View, match


def triangulate(
    structure: Structure, memory: Memory, newest: int, window: list[int]
) -> list[tuple[int, int]]:
    """Match a frame with those of the window, create landmarks, and continue existing tracks.

    Matches are mutual nearest neighbours that pass the ratio test and lie near the epipolar line.
    Two keypoints without a landmark create one if the angle of their rays is wide enough and the
    landmark projects back to both. If one of them observes a landmark already, the other observes
    it, too, provided that it projects there.

    Returns pairs of landmarks whose keypoints match, so that they may be duplicates.
    """
    frame = structure.frames[newest]
    duplicates: list[tuple[int, int]] = []
    for i in sorted(window):
        duplicates += _pair(structure, memory, structure.frames[i], frame)
    return duplicates


def _pair(structure: Structure, memory: Memory, old: Frame, new: Frame) -> list[tuple[int, int]]:
    views = [_view(structure, frame) for frame in (old, new)]
    a, b = match(views[0], views[1], RATIO, structure.max_error(new.camera_id)).rows.T
    landmark_a, landmark_b = old.landmarks[a], new.landmarks[b]
    fresh = (landmark_a < 0) & (landmark_b < 0)
    _create_landmarks(structure, memory, old, new, a[fresh], b[fresh])
    only_a, only_b = (landmark_a >= 0) & (landmark_b < 0), (landmark_a < 0) & (landmark_b >= 0)
    _continue_tracks(structure, memory, new, b[only_a], landmark_a[only_a])
    _continue_tracks(structure, memory, old, a[only_b], landmark_b[only_b])
    both = (landmark_a >= 0) & (landmark_b >= 0) & (landmark_a != landmark_b)
    return list(zip(landmark_a[both].tolist(), landmark_b[both].tolist(), strict=True))


def _view(structure: Structure, frame: Frame) -> View:
    if frame.descriptors is None:
        raise ValueError(f"{frame.name}: the frame has left the window and has no descriptors")
    poses = frame.local_poses(np.arange(len(frame.rays)))
    focal, kind = structure.focal(frame.camera_id), structure.options.kind
    return View(frame.descriptors, frame.rays, poses, focal, kind)


def _create_landmarks(
    structure: Structure, memory: Memory, old: Frame, new: Frame, a: Ids, b: Ids
) -> None:
    if not len(a):
        return
    relative = relative_pose(old.local_poses(a), new.local_poses(b))
    depth, angle = depth_of_first(*relative, old.rays[a], new.rays[b])
    wide = (depth > 0) & (angle > np.radians(structure.options.min_angle))
    a, b, depth = a[wide], b[wide], depth[wide]
    points = old.points(a, depth)
    count = len(points)
    poses = np.concatenate(
        [np.broadcast_to(f.local_poses(r), (count, 3, 4)) for f, r in ((old, a), (new, b))]
    )
    seen = np.concatenate([old.rays[a], new.rays[b]])
    focal = np.repeat([structure.focal(f.camera_id) for f in (old, new)], count)
    which, pixel = np.tile(np.arange(count), 2), structure.pixel(new.camera_id)
    points = refine_points(points, which, poses, seen, focal, iterations=2, huber=pixel)
    errors = pixel_errors(np.tile(points, (2, 1)), poses, seen, focal)
    limits = np.repeat([structure.max_error(f.camera_id) for f in (old, new)], count)
    fits = (errors <= limits).reshape(2, count).all(0)
    a, b = a[fits], b[fits]
    ids = structure.create(points[fits])
    for frame, rows in ((old, a), (new, b)):
        structure.observe(frame, rows, ids)
        update_prototypes(memory, frame, rows)


def _continue_tracks(
    structure: Structure, memory: Memory, frame: Frame, rows: Ids, ids: Ids
) -> None:
    """Let keypoints observe landmarks that project to them and are new to the frame."""
    if not len(rows):
        return
    poses = np.broadcast_to(frame.local_poses(rows), (len(ids), 3, 4))
    focal = structure.focal(frame.camera_id)
    errors = pixel_errors(structure.positions[ids], poses, frame.rays[rows], focal)
    # Landmarks may have been created, and keypoints assigned, since the match.
    fits = (errors <= structure.max_error(frame.camera_id)) & (frame.landmarks[rows] < 0)
    fits &= ~np.isin(ids, frame.seen)
    rows, ids = rows[fits], ids[fits]
    _, first = np.unique(ids, return_index=True)
    rows, ids = rows[first], ids[first]
    structure.observe(frame, rows, ids)
    update_prototypes(memory, frame, rows)


def update_prototypes(memory: Memory, frame: Frame, rows: Ids) -> None:
    """Add the codes of keypoints to the prototypes of their landmarks (Eq. 1 and 2)."""
    if len(rows) and frame.in_window:
        memory.add(frame.landmarks[rows], frame.codes[rows])
