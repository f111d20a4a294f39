"""Decides which frames become keyframes."""

from __future__ import annotations

import numpy as np

from protomark.mapping.frame import Frame
from protomark.mapping.structure import Structure

# A frame is a keyframe if it sees less than this share of the landmarks of the last keyframe, or if
# those that both see have moved in the image by this share of its longer side (median).
_MIN_SHARE_SEEN = 0.8
_MIN_MOTION = 0.02
_MIN_COMMON = 40


def is_keyframe(structure: Structure, last: Frame | None, frame: Frame) -> bool:
    """Whether a frame with its matches adds enough to the last keyframe."""
    if last is None or last.camera_id != frame.camera_id:
        return True
    rows, others = frame.observed, last.observed
    common, here, there = np.intersect1d(
        frame.landmarks[rows], last.landmarks[others], return_indices=True
    )
    if len(common) < max(_MIN_SHARE_SEEN * len(others), _MIN_COMMON):
        return True
    moved = frame.keypoints[rows[here]] - last.keypoints[others[there]]
    limit = structure.tolerance(frame.camera_id, _MIN_MOTION)
    return bool(np.median(np.linalg.norm(moved, axis=1)) > limit)
