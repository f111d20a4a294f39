"""What does not fit is taken out again."""

from __future__ import annotations

import numpy as np

from protomark.localization.absolute_pose import centre
from protomark.mapping.memory import Memory
from protomark.mapping.structure import Ids, Observations, Structure
from protomark.tracks.geometry import widest_angle

# A landmark is given up when the window has left it behind with fewer observations.
_CONFIRMED = 3
# Below this share of the angle that makes a landmark, it is no longer one.
_ANGLE_SHARE = 0.6


def cull(
    structure: Structure,
    memory: Memory,
    frames: list[int],
    max_error: float,
    min_angle: float,
) -> int:
    """Take out observations off their landmark, and landmarks that too little speaks for.

    Observations of frames in the window are taken back from the memory exactly; of those that have
    left it the descriptor is gone: they leave the geometry, and their share stays in the prototype.

    Args:
        structure: frames and landmarks.
        memory: what they look like.
        frames: places of the frames to look at, with their landmarks.
        max_error: largest reprojection error, as a share of the image's longer side.
        min_angle: smallest angle between two rays that makes a landmark, degrees.

    Returns:
        Number of landmarks that are gone.
    """
    seen = structure.observations(frames)
    limit = np.array(
        [structure.tolerance(f.camera_id, max_error) for f in structure.frames], np.float64
    )
    off = structure.errors(seen) > limit[seen.frames]
    drop(structure, memory, seen.where(off))
    touched = np.unique(seen.landmarks)
    return discard_weak(structure, memory, touched, min_angle)


def drop(structure: Structure, memory: Memory, seen: Observations) -> None:
    """Take observations away."""
    for place in np.unique(seen.frames).tolist():
        frame = structure.frames[place]
        rows = seen.rows[seen.frames == place]
        if frame.encoded is not None:
            memory.remove(frame.landmarks[rows], frame.encoded[rows])
        frame.landmarks[rows] = -1


def discard_weak(structure: Structure, memory: Memory, ids: Ids, min_angle: float) -> int:
    """Give up those of some landmarks that one frame sees, or that were never confirmed."""
    counts = structure.counts()
    gone = counts[ids] < 2
    old = structure.born[ids] <= _left_behind(structure)
    gone |= old & (counts[ids] < _CONFIRMED)
    angles = _angles(structure, ids)
    gone |= angles < np.radians(_ANGLE_SHARE * min_angle)
    forget(structure, memory, ids[gone])
    return int(gone.sum())


def forget(structure: Structure, memory: Memory, ids: Ids) -> None:
    """Take landmarks out of structure and memory."""
    ids = ids[structure.alive[ids]]
    if len(ids):
        # A landmark whose observations were all taken back has left the memory already.
        memory.discard(ids[memory.known(ids)])
        structure.discard(ids)


def _left_behind(structure: Structure) -> int:
    """Landmarks born no later than this were made before the window's frames."""
    for place, frame in enumerate(structure.frames):
        if frame.descriptors is not None:
            return place
    return len(structure.frames)


def _angles(structure: Structure, ids: Ids) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(n,) widest angle between two rays of each landmark, radians."""
    place = np.full(len(structure.positions), -1)
    place[ids] = np.arange(len(ids))
    frames, landmarks = structure.pairs(structure.keyframes())
    landmark = place[landmarks]
    frames, landmark = frames[landmark >= 0], landmark[landmark >= 0]
    if not len(landmark):
        return np.zeros(len(ids))
    centers = centre(np.array([frame.pose for frame in structure.frames]))
    order = np.argsort(landmark, kind="stable")
    return widest_angle(structure.positions[ids], landmark[order], centers[frames[order]])
