"""Maps that calibrate their own camera: starts that compete, and what stays open."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapping_scene import show, structure_of, turn_and_approach, walk, write_images
from protomark.geometry.camera import Camera
from protomark.geometry.pose import (
    transform,
)
from protomark.interrupt import Interrupted
from protomark.mapping import starts, trust
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.self_calibration import (
    Calibration,
    elect_focal_length,
    is_plausible,
)
from protomark.mapping.session import make_map
from protomark.mapping.survey import MatchedPair
from test_mapping import run
from tracks_scene import PINHOLE

SIZE = PINHOLE.width, PINHOLE.height
IMAGE = InputImage(0, "", 0.0, None)


def turning_pairs(count: int, noise: float, planar: bool = False) -> list[MatchedPair]:
    """Matches of a camera that turns around points while it looks at them."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (300, 3))
    if planar:
        points[:, 2] = 0
    views = []
    for i in range(count):
        rotation = cv2.Rodrigues(np.array([0.2 * np.sin(i), 0.15 * i, 0.1 * np.cos(2 * i)]))[0]
        shift = np.array([0.2 * np.sin(3 * i), 0.1 * np.cos(i), 3.5 + 0.3 * np.sin(2 * i)])
        local = transform(np.column_stack([rotation, shift]), points)
        views.append(PINHOLE.project(local) + noise * rng.normal(size=(len(points), 2)))
    return [
        MatchedPair((IMAGE, IMAGE), views[i], views[i + step])
        for i in range(count)
        for step in (1, 2, 4)
        if i + step < count
    ]


def test_frames_elect_the_focal_length() -> None:
    found = elect_focal_length(turning_pairs(14, 0.3), SIZE)
    assert found == pytest.approx(300, rel=0.06)


def test_frames_of_a_plane_elect_no_focal_length() -> None:
    assert elect_focal_length(turning_pairs(14, 0.3, planar=True), SIZE) is None
    assert elect_focal_length(turning_pairs(14, 0.3)[:5], SIZE) is None


@pytest.mark.parametrize(
    ("focal", "distortion", "plausible"),
    [
        (610, 0.0, True),
        (520, 0.26, True),
        (350, -0.2, True),
        (12202, 192.8, False),
        (3597, 14.5, False),
        (150, 0.0, False),
        (610, 3.0, False),
        (320, -0.9, False),
        (1340, 2.4, False),
    ],
)
def test_what_a_lens_can_be(focal: float, distortion: float, plausible: bool) -> None:
    camera = Camera("SIMPLE_RADIAL", 640, 480, (focal, 320, 240, distortion))
    assert is_plausible(camera) == plausible


def test_a_restart_needs_proof() -> None:
    calibration = Calibration(700.0)
    assert not calibration.needs_restart(900.0), "nothing is determined"
    calibration.deviation = 0.004
    assert not calibration.needs_restart(710.0)
    assert calibration.needs_restart(900.0)
    again = calibration.restarted(900.0)
    assert again.start == 900
    assert again.limit == pytest.approx(0.006)
    for _ in range(2):
        again = again.restarted(900.0)
    assert not again.needs_restart(700.0), "it ends"


@pytest.fixture(scope="module")
def sliding(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera that neither turns nor comes closer: every focal length fits."""
    poses = walk(7)
    poses[:, :, :3] = np.eye(3)
    poses[:, 2, 3] = poses[:, 1, 3] = 0
    return write_images(tmp_path_factory.mktemp("sliding") / "images", poses)


def test_ctrl_c_while_starts_compete(
    sliding: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = MappingOptions(descriptor="orb", max_keypoints=300)
    make_map(MapRequest(sliding, tmp_path / "scene", settings))
    compete = starts.compete

    def interrupted(*arguments):  # type: ignore[no-untyped-def]
        os.kill(os.getpid(), signal.SIGINT)
        return compete(*arguments)

    stopped = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(starts, "compete", interrupted)
        with pytest.raises(Interrupted):
            make_map(MapRequest(sliding, stopped, settings))
    make_map(MapRequest(sliding, stopped, settings, resume=True))
    for name in ("scene.pmk", "trajectory.txt"):
        assert (stopped / name).read_bytes() == (tmp_path / "scene" / name).read_bytes()


def test_what_cannot_be_determined_is_said(sliding: Path, tmp_path: Path) -> None:
    done = run(sliding, "-o", tmp_path / "scene", "-d", "orb")
    assert done.returncode == 1
    assert "do not determine the focal length" in done.stdout
    report = json.loads((tmp_path / "scene/report.json").read_text())
    assert "do not determine the focal length" in report["warnings"][0]
    assert "320 to 461 fit as well" in report["warnings"][0]
    assert 0.3 * 320 <= report["camera"]["params"][0] <= 3 * 320
    assert "do not determine" in (tmp_path / "scene/report.html").read_text()


def test_the_start_that_explains_most_goes_on() -> None:
    images = [
        InputImage(i, f"{i}.png", float(i), show(pose))
        for i, pose in enumerate(turn_and_approach(12))
    ]
    camera = Camera("SIMPLE_RADIAL", 320, 240, (760.0, 160.0, 120.0, 0.0))
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=500, calibrate=True), camera)
    assert mapper.calibration is not None
    assert not starts.needs_rivals(mapper, at_end=True), "it starts with no guess"
    mapper.calibration.guessed = True
    for image in images:
        mapper.add(image)
    assert not starts.needs_rivals(mapper), "there may be more keyframes"
    assert starts.needs_rivals(mapper, at_end=True)
    assert starts.compete(mapper, images, lambda: True) is None
    best = starts.compete(mapper, images, lambda: False)
    assert best is not None
    assert best.calibration is not None
    assert best.calibration.start == pytest.approx(0.6 * 320)
    assert not starts.needs_rivals(best, at_end=True), "starts compete once"


@pytest.mark.parametrize("turning", [True, False])
def test_a_calibration_is_open_if_another_focal_length_fits_as_well(turning: bool) -> None:
    """A straight road on which an early adjustment claimed a focal length, and a winding one."""
    poses = walk(30)
    for i, pose in enumerate(poses):
        turn = 0.02 * i * turning
        pose[:, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
        pose[:, 3] = -pose[:, :3] @ [i * turn / 2, 0.02 * np.sin(i), 0.3 * i]
    rng = np.random.default_rng(0)
    points = rng.uniform([-6, -2, 12], [10, 1, 30], (300, 3))
    camera = Camera("SIMPLE_RADIAL", 320, 240, (300.0, 160.0, 120.0, 0.0))
    mapper = Mapper(MappingOptions(descriptor="orb", calibrate=True), camera)
    assert mapper.calibration is not None
    mapper.calibration.deviation = 0.005
    mapper.structure = structure_of(poses, points, camera)
    codes = mapper.memory.encode(rng.integers(0, 256, (300, 32), np.uint8))
    mapper.memory.add(mapper.structure.ids, codes)
    mapper.finish()
    warnings = trust.warnings(mapper)
    assert any("250 to 360 fit as well" in one for one in warnings) != turning
    mapper.calibration.given = True
    assert trust.warnings(mapper) == []
