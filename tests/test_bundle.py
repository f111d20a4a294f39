"""Bundle adjustment of simulated observations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mapping_scene import turn_and_approach
from protomark.geometry import bundle as bundles
from protomark.geometry.bundle import Bundle
from protomark.geometry.pose import camera_centers, transform

FOCAL, DISTORTION = 300.0, -0.1
COUNT = 120


def simulated(moved: float = 0.0, lens: tuple[float, float] = (FOCAL, DISTORTION)) -> Bundle:
    """Ten frames that see most of the points; all but the first two are moved."""
    rng = np.random.default_rng(0)
    poses = turn_and_approach(10)
    points = rng.uniform([-1.5, -1, 2.5], [1.5, 1, 4], (COUNT, 3))
    seen = rng.random((10, COUNT)) < 0.8
    frame, point = np.nonzero(seen)
    local = transform(poses[frame], points[point])
    rays = local[:, :2] / local[:, 2:]
    stretch = FOCAL * (1 + DISTORTION * (rays**2).sum(1))
    moving = np.arange(10) > 1
    for pose in poses[moving]:
        pose[:, :3] = cv2.Rodrigues(moved * rng.normal(size=3))[0] @ pose[:, :3]
        pose[:, 3] += moved * rng.normal(size=3)
    return Bundle(
        poses=poses,
        moving=moving,
        camera=np.zeros(10, np.int64),
        lenses=np.array([lens]),
        refined=np.array([[lens != (FOCAL, DISTORTION)] * 2]),
        points=points + moved * rng.normal(size=points.shape),
        frame=frame,
        point=point,
        pixels=stretch[:, None] * rays,
        sigma=np.ones(len(frame)),
    )


@pytest.mark.parametrize("chunk", [500, 7])
@pytest.mark.parametrize("lens", [(FOCAL, DISTORTION), (320.0, 0.0)])
def test_poses_points_and_lens_are_found(
    chunk: int, lens: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundles, "_CHUNK", chunk)
    monkeypatch.setattr(bundles, "_MIN_GAIN", 0.0)
    bundle, true = simulated(0.02, lens), simulated()
    assert np.median(bundle.errors()) > 1
    bundle.adjust(60)
    assert bundle.errors().max() < 1e-3
    np.testing.assert_allclose(bundle.lenses, [[FOCAL, DISTORTION]], rtol=1e-4)
    np.testing.assert_allclose(bundle.poses, true.poses, atol=1e-4)
    np.testing.assert_allclose(bundle.points, true.points, atol=1e-3)


def test_uncertain_keypoints_count_less() -> None:
    off = []
    for sigma in (1.0, 20.0):
        bundle, true = simulated(), simulated()
        wrong = bundle.point % 3 == 0
        bundle.pixels[wrong] += 3.0
        bundle.sigma[wrong] = sigma
        bundle.adjust(30)
        off.append(np.linalg.norm(camera_centers(bundle.poses) - camera_centers(true.poses)))
    assert off[1] < 0.1 * off[0]


def test_rays_that_count_from_cameras_of_their_own() -> None:
    bundle, true = simulated(0.02), simulated()
    turn = cv2.Rodrigues(np.array([0.0, 0.3, 0.0]))[0]
    local = transform(true.poses[true.frame], true.points[true.point]) @ turn.T
    bundle.lenses = np.array([[FOCAL, 0.0]])
    bundle.pixels = FOCAL * local[:, :2] / local[:, 2:]
    bundle.turns = np.repeat(turn[None], len(local), axis=0)
    bundle.adjust(60)
    assert bundle.errors().max() < 0.1
    np.testing.assert_allclose(bundle.poses, true.poses, atol=1e-3)


def test_deviation_of_the_focal_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundles, "_MIN_GAIN", 1e-9)
    found, deviations = [], []
    for seed in range(100, 130):
        bundle = simulated(lens=(FOCAL + 1, DISTORTION))
        bundle.pixels += np.random.default_rng(seed).normal(0, 0.3, bundle.pixels.shape)
        bundle.adjust(30)
        found.append(bundle.lenses[0, 0])
        deviations.append(float(bundle.focal_deviations()[0]))
    spread = np.std(found) / FOCAL
    assert 0.5 * spread < np.median(deviations) < 2 * spread


def test_the_solver_of_the_reduced_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundles, "_BLOCK", 6)
    rng = np.random.default_rng(0)
    band = np.abs(np.subtract.outer(np.arange(45), np.arange(45))) < 9
    band[-3:], band[:, -3:] = True, True
    matrix = np.where(band, rng.normal(size=(45, 45)), 0)
    matrix = matrix + matrix.T + 40 * np.eye(45)
    target = rng.normal(size=45)
    np.testing.assert_allclose(
        bundles._solve(matrix.copy(), target), np.linalg.solve(matrix, target), atol=1e-12
    )
    assert not len(bundles._solve(np.zeros((0, 0)), np.zeros(0)))
