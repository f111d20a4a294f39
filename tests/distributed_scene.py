"""Sessions with random descriptors for distributed builds, and what one process makes of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import protomark as pm
from protomark.geometry.camera import Camera
from protomark.maps.build import build_map
from protomark.maps.origin import tracks_metadata
from protomark.maps.sources import read_places
from protomark.tracks.file import Tracks

METADATA = {"created": "2026-12-01T00:00:00Z", "frame": "metres"}


def session(landmarks: int, seed: int, observations: int = 5) -> Tracks:
    """Observations of random landmarks, of which one is seen so often that order matters.

    Ids have gaps, some keypoints have no landmark, and some landmarks are seen once.
    """
    rng = np.random.default_rng(seed)
    count = landmarks * observations
    rows = np.sort(rng.integers(0, landmarks, count)) + rng.integers(-50, 50, count)
    rows = np.clip(rows, 0, landmarks - 1)
    often = rng.choice(count, 2000, replace=False)
    rows[often] = 5
    descriptors = rng.integers(0, 256, (count, 64), dtype=np.uint8)
    # Of one appearance, yet different.
    descriptors[often] = descriptors[often[0]]
    descriptors[often, :2] = rng.integers(0, 256, (2000, 2), dtype=np.uint8)
    ids = np.arange(landmarks, dtype=np.int64) * 3 + 7
    labels = np.where(rng.random(count) < 0.1, -1, ids[rows])
    frames = count // 500
    return Tracks(
        descriptor="freak",
        cameras={1: Camera("PINHOLE", 640, 480, (500.0 + seed, 500.0, 320.0, 240.0))},
        keyframe_names=[f"{i}.jpg" for i in range(frames)],
        keyframe_camera=np.ones(frames, np.int32),
        cam_from_world=np.tile(np.eye(3, 4), (frames, 1, 1)),
        offsets=np.linspace(0, count, frames + 1).astype(np.int64),
        keypoints=rng.uniform(0, 480, (count, 2)).astype(np.float32),
        sizes=np.full(count, 7, np.float32),
        angles=rng.uniform(0, 359, count).astype(np.float32),
        responses=np.ones(count, np.float32),
        octaves=np.zeros(count, np.int32),
        descriptors=descriptors,
        landmark_of_keypoint=labels,
        landmark_ids=ids,
        landmark_positions=rng.normal(0, 50, (landmarks, 3)),
        info={"detector": {"name": "FAST", "seed": seed}},
    )


def write_sessions(folder: Path, landmarks: Sequence[int] = (9000, 5000, 12000)) -> list[Path]:
    paths = []
    for i, count in enumerate(landmarks):
        paths.append(folder / f"session{i}.freak.safetensors")
        session(count, i).save(paths[-1])
    return paths


def one_process(paths: Sequence[Path], file: Path) -> pm.PrototypeMap:
    """The map that `protomark build` makes."""
    seen = read_places(paths)
    scene = build_map(seen, pm.Encoder.load("freak"), min_observations=1)
    scene.metadata = tracks_metadata(seen) | METADATA
    scene.save(file)
    return scene


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def shard_maps(folder: Path) -> Iterator[pm.PrototypeMap]:
    """The learning maps of a folder of shards."""
    for shard in pm.ShardedMap(folder).shards:
        assert shard.learning is not None
        scene = pm.open(folder / shard.learning.name)
        assert isinstance(scene, pm.PrototypeMap)
        yield scene


def joined(folder: Path, file: Path) -> bytes:
    """All shards merged, as one map file."""
    parts = list(shard_maps(folder))
    scene = pm.PrototypeMap(parts[0].encoder, parts[0].dim, parts[0].appearance_bits)
    for part in parts:
        scene.merge_map(part)
    scene.metadata = dict(pm.ShardedMap(folder).metadata)
    scene.save(file)
    return file.read_bytes()
