"""Tracks files: anything invalid is refused with the names of the file and the field."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from protomark.geometry.camera import CAMERA_MODELS, Camera
from protomark.tracks.file import Tracks
from small_tracks import small_tracks

Arrays = dict[str, NDArray[Any]]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    small_tracks().save(tmp_path / "a.orb.safetensors")
    return tmp_path / "a.orb.safetensors"


def change(path: Path, made: Callable[[Arrays, dict[str, str]], None]) -> None:
    """Change a tracks file without `Tracks.save` and its checks."""
    with safe_open(path, "numpy") as file:
        header = dict(file.metadata())
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    made(arrays, header)
    path.write_bytes(save(arrays, header))


def refused(path: Path, *words: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Tracks.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    for word in words:
        assert word in message
    message.encode()


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("params", [], "4 parameters, not 0"),
        ("params", [500.0], "4 parameters, not 1"),
        ("params", [500.0] * 5, "4 parameters, not 5"),
        ("params", "1234", "params"),
        ("params", ["1", "2", "3", "4"], "params"),
        ("params", {"1": 0, "2": 0, "3": 0, "4": 0}, "params"),
        ("params", [500.0, True, 3.0, 4.0], "params"),
        ("params", [500.0, None, 3.0, 4.0], "params"),
        ("params", [500.0, float("nan"), 3.0, 4.0], "parameters"),
        ("params", [500.0, float("inf"), 3.0, 4.0], "parameters"),
        ("params", [500.0, 10**400, 3.0, 4.0], "too large"),
        ("params", None, "params"),
        ("model", "NOPE", "COLMAP has no camera model 'NOPE'"),
        ("model", "\ud800", "COLMAP has no camera model"),
        ("model", ["PINHOLE"], "COLMAP has no camera model"),
        ("model", "FULL_OPENCV", "12 parameters, not 4"),
        ("width", 0, "pixels"),
        ("width", "640", "pixels"),
        ("height", 2**31, "pixels"),
    ],
)
def test_a_camera_is_one_of_colmaps(field: str, value: Any, word: str, path: Path) -> None:
    def made(_: Arrays, header: dict[str, str]) -> None:
        cameras = json.loads(header["cameras"])
        cameras["1"][field] = value
        header["cameras"] = json.dumps(cameras)

    change(path, made)
    refused(path, "cameras: '1': ", word)


def test_every_camera_model_is_read(tmp_path: Path) -> None:
    tracks = small_tracks()
    for i, (model, count) in enumerate(CAMERA_MODELS.items()):
        tracks.cameras[i + 2] = Camera(model, 640, 480, (1.5,) * count)
    tracks.save(tmp_path / "t.safetensors")
    assert Tracks.load(tmp_path / "t.safetensors").cameras == tracks.cameras
    tracks.cameras[2] = Camera("PINHOLE", 640, 480, ())
    with pytest.raises(ValueError, match=r"camera 2: .*4 parameters, not 0"):
        tracks.save(tmp_path / "t.safetensors")


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ("keyframe_names", '"ab"'),
        ("keyframe_names", '{"a.png": 1, "b.png": 2}'),
        ("keyframe_names", '["a.png", 2]'),
        ("keyframe_names", "2"),
        ("keyframe_names", r'["a.png", "\ud800"]'),
        ("keyframe_names", '["a.png"'),
        ("keyframe_names", "[" * 30_000),
        ("info", r'{"sequence": "\udfff"}'),
        ("info", r'{"\udfff": 1}'),
        ("info", "[1]"),
        ("info", "no"),
        ("cameras", "[1]"),
        ("cameras", "{"),
        ("version", "-3"),
        ("version", "0"),
        ("version", "2"),
        ("version", " 1"),
        ("version", "one"),
        ("version", "9" * 5000),
    ],
)
def test_what_the_header_says_is_checked(field: str, text: str, path: Path) -> None:
    change(path, lambda _, header: header.update({field: text}))
    refused(path, field)


@pytest.mark.parametrize(
    "name",
    ["cam_from_world", "keypoints", "sizes", "angles", "responses", "landmark_positions"],
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_every_number_is_finite(name: str, value: float, path: Path) -> None:
    def made(arrays: Arrays, _: dict[str, str]) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name].reshape(-1)[3] = value

    change(path, made)
    refused(path, f"{name} contains NaN or infinity")


def test_half_a_character_is_not_saved(tmp_path: Path) -> None:
    tracks = small_tracks()
    tracks.descriptor = "orb\ud800"
    with pytest.raises(ValueError, match="descriptor is not a text"):
        tracks.save(tmp_path / "t.safetensors")
