"""Predicts the pose of a frame from the poses of its neighbours in the input."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from protomark.extras import optional
from protomark.geometry.pose import relative_pose
from protomark.mapping.frame import Array, Frame

# Frames predict the poses of frames at most this far away in the input.
MAX_STEP = 3


def predict(frames: Iterable[Frame], index: int, camera_id: int) -> Array | None:
    """The pose of a camera that moves at constant velocity through the two nearest frames.

    It is the pose of the nearest frame if only one is near, and None if none is.
    """
    by_index = {frame.index: frame.pose for frame in frames if frame.camera_id == camera_id}
    near = _nearest(by_index, index)
    if near is None:
        return None
    other = _nearest({i: by_index[i] for i in by_index if i != near}, near)
    if other is None:
        return by_index[near]
    share = (index - near) / (near - other)
    return _extrapolate(by_index[other], by_index[near], share)


def _nearest(by_index: dict[int, Array], index: int) -> int | None:
    """The nearest frame within `MAX_STEP`, the earlier one of two."""
    for step in range(1, MAX_STEP + 1):
        for other in (index - step, index + step):
            if other in by_index:
                return other
    return None


def _extrapolate(first: Array, second: Array, share: float) -> Array:
    """The pose after a further share of the screw motion from one pose to another."""
    cv2 = optional("cv2")
    rotation, shift = relative_pose(first, second)
    turn = np.asarray(cv2.Rodrigues(rotation)[0][:, 0], np.float64)
    velocity = np.linalg.solve(_translation_jacobian(turn), shift)
    pose = cv2.Rodrigues(share * turn)[0] @ second
    pose[:, 3] += _translation_jacobian(share * turn) @ (share * velocity)
    return np.asarray(pose)


def _translation_jacobian(turn: Array) -> Array:
    """The (3, 3) integral of the rotation, which maps a velocity to the translation it causes."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)
