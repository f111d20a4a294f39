"""The numbered examples run; those that need no file of the user's as they are."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
IMAGES = Path(__file__).parent / "data" / "orbslam3"


def run(name: str, folder: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["01_map_and_search.py", "03_mapping_session.py"])
def test_examples_of_maps(name: str, tmp_path: Path) -> None:
    assert "landmarks" in run(name, tmp_path)


@pytest.mark.parametrize("name", ["02_read_map_without_protomark.py", "05_hloc_poses.py"])
def test_examples_say_how_they_are_called(name: str) -> None:
    if name.startswith("05"):
        pytest.importorskip("pycolmap")
    command = [sys.executable, str(EXAMPLES / name), "-h"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert f"python examples/{name}" in done.stderr
    assert "Traceback" not in done.stderr


def test_hloc_poses(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    text = run("05_hloc_poses.py", tmp_path)
    assert "9 of 9 frames localized" in text
    assert float(re.search(r"median error ([\d.]+)%", text)[1]) < 0.1  # type: ignore[index]
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    assert {len(line.split()) for line in lines} == {8}


def test_detector_as_rtabmap_calls_it() -> None:
    """By file name, with an int and a gray image in memory of its own (PyDetector.cpp)."""
    path = EXAMPLES / "04_rtabmap_detector.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.init(0)
    image = cv2.imread(str(IMAGES / "9.000000.jpg"), cv2.IMREAD_GRAYSCALE)
    found = [module.detect(image), module.detect(image[:, ::-1].copy()[:, ::-1])]
    for keypoints, codes in (*found, module.detect(np.zeros((360, 480), np.uint8))):
        assert keypoints.dtype == codes.dtype == np.float32
        assert keypoints.flags.c_contiguous
        assert codes.flags.c_contiguous
        assert keypoints.shape == (len(codes), 3)
        assert codes.shape[1:] == (32,)
    (keypoints, codes), again = found
    assert 200 < len(keypoints) <= 1000
    assert np.array_equal(codes, again[1])
    assert (keypoints[:, :2] >= -0.5).all()
    assert (keypoints[:, :2] < [480, 360]).all()
    # RTAB-Map's words: the nearest by Euclidean distance, if clearly nearer than the second.
    height, width = image.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 10, 0.95)
    turned, turned_codes = module.detect(cv2.warpAffine(image, turn, (width, height)))
    distances = np.linalg.norm(turned_codes[:, None] - codes, axis=2)
    nearest, second = np.argsort(distances, axis=1)[:, :2].T
    rows = np.arange(len(turned))
    sure = distances[rows, nearest] < 0.8 * distances[rows, second]
    expected = keypoints[nearest, :2] @ turn[:, :2].T + turn[:, 2]
    right = np.linalg.norm(expected - turned[:, :2], axis=1) < 3
    assert sure.sum() > 50
    assert right[sure].mean() > 0.9
