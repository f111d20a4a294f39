"""A synthetic scene: landmarks with noisy descriptors, and cameras around them."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks

CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.05))


def ring_scene(
    keyframes: int = 20,
    landmarks: int = 400,
    *,
    bits: int = 64,
    noise: float = 0.1,
    clutter: int = 40,
    seed: int = 0,
) -> Tracks:
    """Keyframes on a ring of radius 6 about landmarks in a cube of side 4.

    Each sees half of the landmarks, half a pixel off, a share `noise` of the bits flipped, and
    `clutter` keypoints of no landmark. Pixels come from COLMAP's formula for SIMPLE_RADIAL.
    """
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-2, 2, (landmarks, 3))
    true_bits = rng.random((landmarks, bits)) < 0.5
    poses, keypoints, descriptors, seen, offsets = [], [], [], [], [0]
    for angle in np.linspace(0, 2 * np.pi, keyframes, endpoint=False):
        pose = looking_inwards(angle)
        pixels = radial_pixels(positions @ pose[:, :3].T + pose[:, 3])
        inside = (pixels >= 0).all(1) & (pixels < (CAMERA.width, CAMERA.height)).all(1)
        ids = np.flatnonzero(inside & (rng.random(landmarks) < 0.5))
        own = true_bits[ids] ^ (rng.random((len(ids), bits)) < noise)
        other = rng.random((clutter, bits)) < 0.5
        poses.append(pose)
        keypoints.append(pixels[ids] + rng.normal(0, 0.5, (len(ids), 2)))
        keypoints.append(rng.uniform(0, (CAMERA.width, CAMERA.height), (clutter, 2)))
        descriptors.append(np.packbits(np.concatenate([own, other]), axis=1, bitorder="little"))
        seen += [ids, np.full(clutter, -1)]
        offsets.append(offsets[-1] + len(ids) + clutter)
    n = offsets[-1]
    return Tracks(
        descriptor="test",
        cameras={1: CAMERA},
        keyframe_names=[f"{i}.jpg" for i in range(keyframes)],
        keyframe_camera=np.ones(keyframes, np.int32),
        cam_from_world=np.array(poses),
        offsets=np.array(offsets),
        keypoints=np.concatenate(keypoints).astype(np.float32),
        sizes=np.ones(n, np.float32),
        angles=np.zeros(n, np.float32),
        responses=np.ones(n, np.float32),
        octaves=np.zeros(n, np.int32),
        descriptors=np.concatenate(descriptors),
        landmark_of_keypoint=np.concatenate(seen),
        landmark_ids=np.arange(landmarks),
        landmark_positions=positions,
    )


def looking_inwards(angle: float) -> NDArray[np.float64]:
    """(3, 4) pose of a camera on the ring that faces the centre, y down."""
    where = 6 * np.array([np.cos(angle), 0, np.sin(angle)])
    ahead = -where / 6
    down = np.array([0.0, 1.0, 0.0])
    rotation = np.stack([np.cross(down, ahead), down, ahead])
    return np.concatenate([rotation, (-rotation @ where)[:, None]], axis=1)


def radial_pixels(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) points before the camera -> (n, 2) pixels by COLMAP's SIMPLE_RADIAL."""
    focal, x, y, k = CAMERA.params
    plane = points[:, :2] / points[:, 2:]
    radius = (plane**2).sum(axis=1, keepdims=True)
    return focal * plane * (1 + k * radius) + (x, y)


@st.composite
def observations(
    draw: st.DrawFn, max_landmarks: int = 12, max_count: int = 9
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Landmarks in any order, each with two or more observations and a 16-bit descriptor."""
    counts = draw(st.lists(st.integers(2, max_count), min_size=1, max_size=max_landmarks))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ids = np.sort(rng.choice(1000, len(counts), replace=False))
    landmarks = rng.permutation(np.repeat(ids, counts))
    # Few distinct bits a byte, so that ties and equal descriptors are common.
    descriptors = rng.integers(0, draw(st.sampled_from([2, 4, 256])), (len(landmarks), 2))
    return landmarks, descriptors.astype(np.uint8)
