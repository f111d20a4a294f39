"""A frame as it comes from the camera, before it has a pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.mapping.structure import Array, Frame


@dataclass
class Sighting:
    """Keypoints and descriptors of a frame.

    Attributes:
        index: place in its input, from 0.
        name: image name.
        time: seconds, or the index where no times are known.
        camera_id: its camera.
        keypoints: (n, 2) float32, pixels.
        rays: (n, 2) float64, undistorted.
        descriptors: (n, bytes) uint8.
        encoded: (n, width), descriptors as the memory compares them.
    """

    index: int
    name: str
    time: float
    camera_id: int
    keypoints: NDArray[np.float32]
    rays: Array
    descriptors: NDArray[np.uint8]
    encoded: NDArray[Any]

    def at(self, pose: Array) -> Frame:
        """The same with a pose, as part of a map; its descriptors are those of the window."""
        return Frame(
            index=self.index,
            name=self.name,
            time=self.time,
            camera_id=self.camera_id,
            pose=np.ascontiguousarray(pose),
            keypoints=self.keypoints,
            landmarks=np.full(len(self.keypoints), -1, np.int64),
            rays=self.rays,
            descriptors=self.descriptors,
            encoded=self.encoded,
        )
