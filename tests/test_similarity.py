"""Similarities between worlds, found exactly and among pairs most of which are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from protomark.geometry.neighbours import near_points
from protomark.geometry.pose import transform
from protomark.geometry.similarity import (
    Similarity,
    find_similarity,
    fit_similarity,
)

Array = NDArray[np.float64]
LIMITS = (0.005, 0.01, 0.02)


def random_similarity(rng: np.random.Generator, scale: float | None = None) -> Similarity:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    scale = float(rng.uniform(0.2, 5)) if scale is None else scale
    return Similarity(scale, rotation, rng.normal(size=3))


def assert_same(found: Similarity, true: Similarity, tolerance: float = 1e-9) -> None:
    assert found.scale == pytest.approx(true.scale, rel=tolerance)
    np.testing.assert_allclose(found.rotation, true.rotation, atol=tolerance)
    np.testing.assert_allclose(found.translation, true.translation, atol=10 * tolerance)


def test_a_similarity_is_taken_back() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    true = random_similarity(rng)
    assert_same(fit_similarity(points, true(points)), true)
    np.testing.assert_allclose(true.inverse()(true(points)), points, atol=1e-12)
    rigid = random_similarity(rng, scale=1)
    assert_same(fit_similarity(points, rigid(points), fixed_scale=True), rigid)


def test_a_mirrored_world_is_not_reached() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    found = fit_similarity(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


@pytest.mark.parametrize("fixed_scale", [False, True])
def test_no_similarity_near_the_fitted_one_is_better(fixed_scale: bool) -> None:
    rng = np.random.default_rng(2)
    points, weights = rng.normal(size=(40, 3)), rng.uniform(0.1, 1, 40)
    to = random_similarity(rng, 1 if fixed_scale else None)(points) + rng.normal(0, 0.05, (40, 3))

    def error(one: Similarity) -> float:
        return float((weights * ((one(points) - to) ** 2).sum(1)).sum())

    best = fit_similarity(points, to, weights, fixed_scale=fixed_scale)
    for _ in range(20):
        turn = fit_similarity(np.eye(3), np.eye(3) + rng.normal(0, 0.01, (3, 3))).rotation
        scale = best.scale * (1 if fixed_scale else 1 + 0.01 * rng.normal())
        moved = best.translation + rng.normal(0, 0.01, 3)
        assert error(Similarity(scale, turn @ best.rotation, moved)) > error(best)


def test_moved_cameras_see_moved_points_alike() -> None:
    rng = np.random.default_rng(3)
    motion, camera = random_similarity(rng), random_similarity(rng, scale=1)
    pose = np.column_stack([camera.rotation, camera.translation])
    points = rng.normal(size=(20, 3))
    moved = transform(motion.move_poses(pose), motion(points))
    np.testing.assert_allclose(moved, motion.scale * transform(pose, points), atol=1e-9)
    np.testing.assert_array_equal(
        motion.move_poses(np.stack([pose, pose]))[1], motion.move_poses(pose)
    )


@pytest.mark.parametrize("fixed_scale", [False, True])
def test_a_similarity_is_found_among_wrong_pairs(fixed_scale: bool) -> None:
    rng = np.random.default_rng(4)
    true = random_similarity(rng, 1 if fixed_scale else None)
    right, wrong = 60, 540
    source = rng.normal(size=(right + wrong, 3))
    target = true(rng.permutation(source))
    target[:right] = true(source[:right] + rng.normal(0, 0.001, (right, 3)))
    reach = (1.5, 1.5 * true.scale)
    found = find_similarity(source, target, reach, LIMITS, fixed_scale=fixed_scale, samples=100_000)
    assert found is not None
    assert found.inliers[:right].all()
    assert found.inliers[right:].sum() < 5
    assert found.chance < -50
    assert_same(found.similarity, true, 0.005)


def test_nothing_is_found_where_nothing_agrees() -> None:
    rng = np.random.default_rng(5)
    source = rng.normal(size=(400, 3))
    for target in (rng.normal(size=(400, 3)), np.zeros((400, 3))):
        assert find_similarity(source, target, (1.5, 1.5), LIMITS, samples=20_000) is None
    # Points near a plane agree with their mirror images.
    found = find_similarity(source, source * [1, 1, -1], (1.5, 1.5), LIMITS, samples=20_000)
    assert found is None or found.inliers.mean() < 0.1
    assert find_similarity(source[:3], source[:3], (1.5, 1.5), LIMITS, samples=1) is None


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_near_points_are_those_within_the_radius(offset: float) -> None:
    rng = np.random.default_rng(6)
    first, second = offset + rng.normal(size=(200, 3)), offset + rng.normal(size=(300, 3))
    found = set(zip(*(part.tolist() for part in near_points(first, second, 0.3)), strict=True))
    distances = np.linalg.norm(first[:, None] - second, axis=2)
    assert found == set(map(tuple, np.argwhere(distances <= 0.3).tolist()))
    assert not len(near_points(first[:0], second, 0.3)[0])
