"""Where a camera should be, by where it was in the frames beside."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from protomark.mapping.structure import Array, Frame
from protomark.tracks.geometry import relative_pose

# Frames further than this from each other in the input say nothing of each other's poses.
REACH = 3


def predict(frames: Iterable[Frame], index: int, camera_id: int) -> Array | None:
    """The pose if the camera moves steadily along the two frames nearest to it in the input.

    Args:
        frames: frames with a pose.
        index: place of the new frame in the input.
        camera_id: its camera.

    Returns:
        (3, 4) cam_from_world, None where no frame is near. Where one is alone, its pose.
    """
    by_index = {frame.index: frame.pose for frame in frames if frame.camera_id == camera_id}
    near = _nearest(by_index, index)
    if near is None:
        return None
    other = _nearest({i: by_index[i] for i in by_index if i != near}, near)
    if other is None:
        return by_index[near]
    share = (index - near) / (near - other)
    return _go_on(by_index[other], by_index[near], share)


def _nearest(by_index: dict[int, Array], index: int) -> int | None:
    """Of the frames within reach the nearest, the one before where two are."""
    for step in range(1, REACH + 1):
        for other in (index - step, index + step):
            if other in by_index:
                return other
    return None


def _go_on(first: Array, second: Array, share: float) -> Array:
    """The pose after a share more of the motion (a screw) from one pose to another."""
    rotation, shift = relative_pose(first, second)
    turn = np.asarray(cv2.Rodrigues(rotation)[0][:, 0], np.float64)
    velocity = np.linalg.solve(_sweep(turn), shift)
    pose = cv2.Rodrigues(share * turn)[0] @ second
    pose[:, 3] += _sweep(share * turn) @ (share * velocity)
    return np.asarray(pose)


def _sweep(turn: Array) -> Array:
    """(3, 3), the shift that a velocity gives while it turns: the integral of the rotation."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)
