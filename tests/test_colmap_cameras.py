"""Cameras given to pycolmap, whose number of parameters must fit their model."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

import protomark as pm
from protomark.files import STATE
from protomark.geometry.camera import CAMERA_MODELS, Camera
from protomark.geometry.colmap import pycolmap
from protomark.mapping.options import MappingOptions
from protomark.mapping.state import load_state

USES: list[Callable[[Camera], Any]] = [
    lambda camera: camera.rays(np.ones((2, 2))),
    lambda camera: camera.project(np.ones((2, 3))),
    lambda camera: camera.focal_length,
]


@pytest.mark.parametrize("use", USES, ids=["rays", "project", "focal_length"])
@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("PINHOLE", (), "has 4 parameters, not 0"),
        ("SIMPLE_RADIAL", (500.0, 320.0, 240.0), "has 4 parameters, not 3"),
        ("PINHOLE", (500.0, 500.0, np.nan, 240.0), "not all finite"),
        ("PINHOLE", "1234", "not all finite"),
        ("NOPE", (500.0,), "COLMAP has no camera model"),
    ],
)
def test_only_whole_cameras_reach_pycolmap(
    use: Callable[[Camera], Any], model: str, params: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        use(Camera(model, 640, 480, params))


def test_models_have_the_parameters_that_pycolmap_gives_them() -> None:
    known = {name: m for name, m in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert len(known.keys() & CAMERA_MODELS.keys()) >= 11
    for name in known.keys() & CAMERA_MODELS.keys():
        camera = pycolmap.Camera.create_from_model_id(1, known[name], 500.0, 640, 480)
        assert len(camera.params) == CAMERA_MODELS[name], name


@pytest.mark.parametrize(
    "camera",
    [
        {"model": "SIMPLE_RADIAL", "width": 10, "height": 10, "params": []},
        {"model": "SIMPLE_RADIAL", "width": 10, "height": 10, "params": "1234"},
        {"model": "NOPE", "width": 10, "height": 10, "params": [1.0]},
        ["SIMPLE_RADIAL", 10, 10, []],
    ],
)
def test_a_map_with_such_a_camera_is_not_continued(camera: Any, tmp_path: Path) -> None:
    options = asdict(MappingOptions("orb", calibrate=True))
    for cameras in ({"1": camera}, [camera]):
        told = {"options": options, "cameras": cameras, "camera_id": 1}
        header = {"format": "protomark-mapping", "version": "1", "state": json.dumps(told)}
        (tmp_path / STATE).write_bytes(save({"positions": np.zeros((1, 3))}, header))
        with pytest.raises(pm.FileError, match=r"state\.safetensors: .*broken \(cameras"):
            load_state(tmp_path)
