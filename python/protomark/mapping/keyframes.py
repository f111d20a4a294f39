"""Decides which frames become keyframes."""

from __future__ import annotations

import numpy as np

from protomark.mapping.frame import Frame
from protomark.mapping.structure import Structure

# A frame becomes a keyframe if it observes less than this share of the landmarks of the last one,
# or if common landmarks have moved by this share of the image's longer side (median).
_MIN_SHARE_SEEN = 0.8
_MIN_MOTION = 0.02
_MIN_COMMON = 40


def is_keyframe(structure: Structure, last: Frame | None, frame: Frame) -> bool:
    """Whether a frame differs enough from the last keyframe to become one."""
    if last is None or last.camera_id != frame.camera_id:
        return True
    rows, last_rows = frame.observed, last.observed
    common, i, j = np.intersect1d(frame.seen, last.seen, return_indices=True)
    if len(common) < max(_MIN_SHARE_SEEN * len(last_rows), _MIN_COMMON):
        return True
    motion = frame.keypoints[rows[i]] - last.keypoints[last_rows[j]]
    limit = structure.tolerance(frame.camera_id, _MIN_MOTION)
    return bool(np.median(np.linalg.norm(motion, axis=1)) > limit)
