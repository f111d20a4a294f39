"""Which landmarks of which sources become which shard."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera

# Bytes of a worker's memory that Python, Ray and an encoder take; what is left is for data.
WORKER_BYTES = 140_000_000
MIN_MEMORY = 200_000_000
# Bytes that a prototype takes at most while a shard is built, indexed and sealed (measured).
PROTOTYPE_BYTES = 320
# Shards begin at multiples of so many landmarks of a source.
BUCKET = 4096
# A piece is encoded by one task; more rows would leave workers without work.
MAX_PIECE = 250_000
# Less than this, and Ray would keep an object in the driver's memory.
MIN_OBJECT = 200_000


@dataclass
class Source:
    """A tracks file, of which the landmarks get a range of ids."""

    name: str
    shown: str  # its path or URL without secrets, for messages
    digest: str  # changes when it does
    url: str  # of the tracks file
    keyframes: int
    keypoints: int
    landmarks: int
    ids: tuple[int, int]
    descriptor: str
    descriptor_bytes: int
    info: dict[str, Any]
    cameras: list[Camera]
    # What is found out about it after all sources are known.
    shift: int = 0
    limit: int = 1  # fewest observations of a landmark
    facts: dict[str, Any] = field(default_factory=dict)
    firsts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # of buckets


@dataclass(frozen=True)
class Segment:
    """Landmarks of a source that go to one shard."""

    source: int  # its number
    start: int  # the first of them among the source's landmarks
    stop: int  # the first after them


@dataclass(frozen=True)
class ShardPlan:
    """A shard to write."""

    segments: tuple[Segment, ...]
    metadata: dict[str, str]
    recipe: str  # SHA-256 of all that its bytes depend on


def data_bytes(memory: int) -> int:
    """Bytes for data in a worker that may take `memory` bytes."""
    return memory - WORKER_BYTES


def piece_rows(memory: int, descriptor_bytes: int, dim: int) -> int:
    """Keypoints that a task encodes at a time."""
    # Read, selected, and turned upright; codes, and codes by shard; labels, their order and ids.
    each = 3 * (descriptor_bytes + 8) + 2 * dim + 40
    return max(BUCKET, min(MAX_PIECE, data_bytes(memory) // (2 * each)))


def cut_segments(costs: Sequence[NDArray[np.int64]], memory: int) -> list[tuple[Segment, ...]]:
    """Cut the landmarks of all sources, one after the other, into shards that fit into memory.

    Args:
        costs: for each source, the prototypes that each bucket of its landmarks has at most.
        memory: bytes of a worker.
    """
    room = data_bytes(memory) // PROTOTYPE_BYTES
    shards: list[tuple[Segment, ...]] = []
    current: list[Segment] = []
    left = room
    for source, buckets in enumerate(costs):
        start = 0
        for i, cost in enumerate(buckets.tolist()):
            if cost > left and (current or i > start):
                if i > start:
                    current.append(Segment(source, start * BUCKET, i * BUCKET))
                shards.append(tuple(current))
                current, start, left = [], i, room
            left -= cost
        if len(buckets) > start:
            current.append(Segment(source, start * BUCKET, len(buckets) * BUCKET))
    if current:
        shards.append(tuple(current))
    return shards


def group_count(segments: int, rows: int, dim: int) -> int:
    """Objects in which a piece of so many rows hands over its segments."""
    return max(1, min(segments, rows * (dim + 8) // MIN_OBJECT))


def segments_of(group: int, groups: int, segments: int) -> tuple[int, int]:
    """The first segment of a group, and the first after it."""
    return group * segments // groups, (group + 1) * segments // groups


def recipe_of(facts: Any) -> str:
    """SHA-256, hexadecimal, of JSON values."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
