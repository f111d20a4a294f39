"""A room of three textured walls at different depths, and a camera that walks past them."""

from __future__ import annotations

import os
import signal
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.geometry.pose import transform
from protomark.interrupt import Interrupted
from protomark.mapping.frame import Frame, InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.structure import Structure
from tracks_scene import PINHOLE

# Depth of each wall (it stands parallel to the x axis and y axis), its extent in x, and its seed.
_WALLS = ((3.0, (-4.0, 6.0), 3), (2.2, (-1.2, -0.3), 5), (1.8, (0.9, 1.7), 7))
_SIDE = 10.0


@cache
def _paper(seed: int) -> NDArray[np.uint8]:
    """Random triangles over each other, whose corners all differ."""
    rng = np.random.default_rng(seed)
    paper = np.full((2000, 2000), 128, np.uint8)
    for size in (300, 120, 60):
        for _ in range(int(1.5 * (2000 / size) ** 2)):
            corners = rng.uniform(0, 2000, 2) + rng.uniform(-size, size, (3, 2)) / 2
            cv2.fillConvexPoly(paper, corners.astype(np.int32), int(rng.integers(0, 256)))
    return paper


def walk(count: int, step: float = 0.08) -> NDArray[np.float64]:
    """(count, 3, 4) cam_from_world of a sideways motion with small rotations and heights."""
    out = []
    for i in range(count):
        center = np.array([i * step - 0.5, 0.05 * np.sin(0.9 * i), 0.02 * i])
        rotation = cv2.Rodrigues(np.array([0.0, 0.08 * np.sin(0.5 * i), 0.01 * i]))[0]
        out.append(np.column_stack([rotation, -rotation @ center]))
    return np.array(out)


def turn_and_approach(count: int) -> NDArray[np.float64]:
    """(count, 3, 4) cam_from_world of a motion that determines the focal length."""
    out = []
    for i in range(count):
        center = np.array([0.1 * i - 0.8, 0.15 * np.sin(0.9 * i), 0.5 * np.sin(0.4 * i) - 0.3])
        turn = np.array([0.15 * np.sin(0.7 * i), 0.2 * np.sin(0.5 * i), 0.05 * i])
        rotation = cv2.Rodrigues(turn)[0]
        out.append(np.column_stack([rotation, -rotation @ center]))
    return np.array(out)


def show(pose: NDArray[np.float64], camera: Camera = PINHOLE, seed: int = 0) -> NDArray[np.uint8]:
    """Renders the image of a camera; every seed gives another room."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    direction = np.column_stack([ray, np.ones(len(ray))]) @ pose[:, :3]
    center = -pose[:, :3].T @ pose[:, 3]
    picture = np.zeros((camera.height, camera.width), np.uint8)
    for depth, (left, right), number in _WALLS:
        hit = center + direction * ((depth - center[2]) / direction[:, 2])[:, None]
        paper = _paper(number + seed)
        at = ((hit[:, :2] + _SIDE / 2) / _SIDE * len(paper)).astype(np.float32)
        at = at.reshape(camera.height, camera.width, 2)
        wall = cv2.remap(paper, at[..., 0], at[..., 1], cv2.INTER_AREA)
        inside = ((hit[:, 0] > left) & (hit[:, 0] < right)).reshape(picture.shape)
        picture[inside] = wall[inside]
    return picture


def write_images(folder: Path, poses: NDArray[np.float64], seed: int = 0, first: int = 1) -> Path:
    """Writes img1.png, img2.png, ... to a new or existing folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(poses, first):
        cv2.imwrite(str(folder / f"img{i}.png"), show(pose, seed=seed))
    return folder


def interrupted_at(
    index: int,
    request: MapRequest,
    monkeypatch: pytest.MonkeyPatch,
    lines: list[str] | None = None,
    number: int = signal.SIGTERM,
) -> None:
    """Send a signal just before the frame of this index is added; `lines` gets the notes."""

    def stop(self: Mapper, picture: InputImage) -> object:
        if picture.index == index:
            os.kill(os.getpid(), number)
        return add(self, picture)

    add = Mapper.add
    notes = [] if lines is None else lines
    with monkeypatch.context() as patch:
        patch.setattr(Mapper, "add", stop)
        with pytest.raises(Interrupted):
            make_map(request, note=notes.append)


def structure_of(poses: np.ndarray, points: np.ndarray, camera: Camera = PINHOLE) -> Structure:
    """Frames that all see the same points, exactly."""
    rng = np.random.default_rng(0)
    structure = Structure({1: camera}, MappingOptions(max_error=0.01))
    ids = structure.create(points)
    for i, pose in enumerate(poses):
        pixels = camera.project(transform(pose, points)) + 0.3 * rng.normal(size=(len(ids), 2))
        frame = Frame(
            *(i, str(i), float(i), 1, pixels.astype(np.float32), camera.rays(pixels)),
            np.ones(len(ids)),
        )
        frame = frame.at(pose)
        structure.frames.append(frame)
        structure.observe(frame, np.arange(len(ids)), ids)
    return structure
