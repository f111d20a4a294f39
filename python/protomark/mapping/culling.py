"""Culls observations and landmarks that do not fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.pose import camera_centers
from protomark.geometry.triangulation import widest_angle
from protomark.mapping.frame import Ids
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Observations, Structure

# A landmark older than the window needs this many observations.
_MIN_CONFIRMED = 3
# A landmark needs this share of the triangulation angle of a new one.
_ANGLE_SHARE = 0.6
# Keyframes are apart, so the rays of this many are.
_MANY = 5


def cull(structure: Structure, memory: Memory, frames: list[int]) -> int:
    """Remove observations with a large error, and landmarks with too few or too narrow rays.

    Returns the number of removed landmarks.

    Observations of frames in the window are subtracted from the memory exactly. Descriptors of
    other frames no longer exist: their observations leave the geometry, but stay in the prototype.
    """
    seen = structure.observations(frames)
    limit = np.array([structure.max_error(f.camera_id) for f in structure.frames], np.float64)
    outlier = structure.errors(seen) > limit[seen.frames]
    remove_observations(structure, memory, seen.where(outlier))
    return cull_landmarks(structure, memory, np.unique(seen.landmarks))


def remove_observations(structure: Structure, memory: Memory, seen: Observations) -> None:
    """Remove observations, from the memory, too, where their descriptors still exist."""
    for index in np.unique(seen.frames).tolist():
        frame = structure.frames[index]
        rows = seen.rows[seen.frames == index]
        if frame.in_window:
            memory.subtract(frame.landmarks[rows], frame.codes[rows])
        frame.landmarks[rows] = -1


def cull_landmarks(structure: Structure, memory: Memory, ids: Ids) -> int:
    """Remove landmarks with one keyframe, without confirmation, or with a narrow angle."""
    counts = structure.counts()
    weak = counts[ids] < 2
    frames = structure.frames
    window_start = next((i for i, frame in enumerate(frames) if frame.in_window), len(frames))
    weak |= (structure.born[ids] <= window_start) & (counts[ids] < _MIN_CONFIRMED)
    few = ids[counts[ids] < _MANY]
    narrow = _angles(structure, few) < np.radians(_ANGLE_SHARE * structure.options.min_angle)
    weak |= np.isin(ids, few[narrow])
    removed = ids[weak & structure.existing[ids]]
    if len(removed):
        # A landmark whose observations were all subtracted has left the memory already.
        memory.remove(removed[memory.contains(removed)])
        structure.remove(removed)
    return int(weak.sum())


def _angles(structure: Structure, ids: Ids) -> NDArray[np.float64]:
    """Widest angle (n,) between two rays of each landmark, radians."""
    number = np.full(len(structure.positions), -1)
    number[ids] = np.arange(len(ids))
    frames, landmarks = structure.pairs(structure.keyframes())
    landmark = number[landmarks]
    frames, landmark = frames[landmark >= 0], landmark[landmark >= 0]
    if not len(landmark):
        return np.zeros(len(ids))
    centers = camera_centers(np.array([frame.pose for frame in structure.frames]))
    order = np.argsort(landmark, kind="stable")
    return widest_angle(structure.positions[ids], landmark[order], centers[frames[order]])
