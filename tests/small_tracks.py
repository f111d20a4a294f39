"""Tracks of two keyframes, without images or COLMAP."""

from __future__ import annotations

import numpy as np

from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks


def small_tracks() -> Tracks:
    rng = np.random.default_rng(0)
    n, landmarks = 40, 10
    return Tracks(
        descriptor="orb",
        cameras={1: Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))},
        keyframe_names=["a.png", "b.png"],
        keyframe_camera=np.ones(2, np.int32),
        cam_from_world=np.tile(np.eye(3, 4), (2, 1, 1)),
        offsets=np.array([0, 20, n]),
        keypoints=rng.uniform(0, 480, (n, 2)).astype(np.float32),
        sizes=np.ones(n, np.float32),
        angles=np.zeros(n, np.float32),
        responses=np.ones(n, np.float32),
        octaves=np.zeros(n, np.int32),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
        landmark_of_keypoint=rng.integers(-1, landmarks, n),
        landmark_ids=np.arange(landmarks),
        landmark_positions=rng.normal(size=(landmarks, 3)),
        info={"sequence": "test", "settings": {"descriptor": "orb"}},
    )
