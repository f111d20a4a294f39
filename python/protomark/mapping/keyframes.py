"""Which frames become keyframes."""

from __future__ import annotations

import numpy as np

from protomark.mapping.structure import Frame, Structure

# A frame is a keyframe if it sees less than this share of what the last keyframe saw, or if what
# both see has moved in the image by this share of its longer side (median).
_SHARE_SEEN = 0.8
_MOVED = 0.02
_FEW = 40


def is_keyframe(structure: Structure, last: Frame | None, frame: Frame) -> bool:
    """Whether a frame, with its matches, adds enough to the last keyframe."""
    if last is None or last.camera_id != frame.camera_id:
        return True
    rows, others = frame.observed, last.observed
    common, mine, theirs = np.intersect1d(
        frame.landmarks[rows], last.landmarks[others], return_indices=True
    )
    if len(common) < max(_SHARE_SEEN * len(others), _FEW):
        return True
    moved = frame.keypoints[rows[mine]] - last.keypoints[others[theirs]]
    limit = structure.tolerance(frame.camera_id, _MOVED)
    return bool(np.median(np.linalg.norm(moved, axis=1)) > limit)
