"""Synthetic tracks: each landmark has a descriptor, distorted by a nuisance that all share.

The nuisance moves more bits than the identity does, so a projection that keeps the directions of
most variance (PCA) keeps the wrong ones, and an encoder that learns from tracks can do better.
"""

from __future__ import annotations

import numpy as np

from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks

IDENTITY, NUISANCE = 10, 4


def scene(
    landmarks: int = 1200,
    bits: int = 128,
    keyframes: int = 30,
    seed: int = 0,
    descriptor: str = "synthetic",
) -> Tracks:
    """One sequence; all seeds share the origin of each bit, like sequences of one descriptor."""
    rng = np.random.default_rng(seed)
    bit = np.random.default_rng(1234)
    of_identity = bit.normal(size=(IDENTITY, bits))
    of_nuisance = 2.0 * bit.normal(size=(NUISANCE, bits))
    identity = rng.normal(size=(landmarks, IDENTITY))
    seen = rng.random((keyframes, landmarks)) < 0.2
    keyframe, landmark = np.nonzero(seen)
    field = identity[landmark] @ of_identity
    field += rng.normal(size=(len(landmark), NUISANCE)) @ of_nuisance
    field += rng.normal(size=field.shape)
    n = len(landmark)
    pose = np.tile(np.eye(3, 4), (keyframes, 1, 1))
    return Tracks(
        descriptor=descriptor,
        cameras={1: Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))},
        keyframe_names=[f"{i:04d}.jpg" for i in range(keyframes)],
        keyframe_camera=np.ones(keyframes, np.int32),
        cam_from_world=pose,
        offsets=np.searchsorted(keyframe, np.arange(keyframes + 1)).astype(np.int64),
        keypoints=rng.uniform(0, 480, (n, 2)).astype(np.float32),
        sizes=np.full(n, 7, np.float32),
        angles=np.full(n, -1, np.float32),
        responses=np.ones(n, np.float32),
        octaves=np.zeros(n, np.int32),
        descriptors=np.packbits(field > 0, axis=1, bitorder="little"),
        landmark_of_keypoint=landmark.astype(np.int64),
        landmark_ids=np.arange(landmarks, dtype=np.int64),
        landmark_positions=rng.normal(size=(landmarks, 3)),
        info={"licence": "CC0-1.0"},
    )
