"""Where a camera should be, by where it was in the frames beside."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from protomark.mapping.structure import Array, Frame

# Frames further than this from each other in the input say nothing of each other's poses.
REACH = 3


def predict(frames: Iterable[Frame], index: int, camera_id: int) -> Array | None:
    """The pose if the camera goes on as it did between two frames beside, before or behind.

    Args:
        frames: frames with a pose.
        index: place of the new frame in the input.
        camera_id: its camera.

    Returns:
        (3, 4) cam_from_world, None where no frame is near. Where one is alone, its pose.
    """
    by_index = {frame.index: frame.pose for frame in frames if frame.camera_id == camera_id}
    for step in range(1, REACH + 1):
        for way in (-step, step):
            last, before = by_index.get(index + way), by_index.get(index + 2 * way)
            if last is None:
                continue
            if before is None:
                return last
            motion = last @ np.linalg.inv(np.vstack([before, [0, 0, 0, 1]]))
            return np.asarray(motion @ np.vstack([last, [0, 0, 0, 1]]))
    return None
