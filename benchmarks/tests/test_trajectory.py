import cv2
import numpy as np
import pytest

from protomark_bench.trajectory import align, trajectory_error


def random_similarity(rng):
    rotation = cv2.Rodrigues(rng.normal(size=3))[0]
    return float(rng.uniform(0.2, 5)), rotation, rng.normal(size=3)


def test_alignment_takes_back_a_similarity():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    scale, rotation, shift = random_similarity(rng)
    found = align(points, scale * points @ rotation.T + shift)
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, shift, atol=1e-9)


def test_alignment_does_not_mirror():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(50, 3))
    found = align(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_no_similarity_near_the_found_one_is_better():
    rng = np.random.default_rng(2)
    true = rng.normal(size=(40, 3))
    scale, rotation, shift = random_similarity(rng)
    estimated = ((true - shift) @ rotation) / scale + 0.05 * rng.normal(size=true.shape)
    best = trajectory_error(estimated, true)
    a = best.alignment

    def rmse(scale, rotation, shift):
        off = scale * estimated @ rotation.T + shift - true
        return np.sqrt((off**2).sum(1).mean())

    assert best.rmse == pytest.approx(rmse(a.scale, a.rotation, a.shift))
    for _ in range(20):
        turn = cv2.Rodrigues(0.01 * rng.normal(size=3))[0]
        moved = a.shift + 0.01 * rng.normal(size=3)
        assert rmse(a.scale * (1 + 0.01 * rng.normal()), turn @ a.rotation, moved) > best.rmse


def test_error_of_known_offsets():
    true = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 1.0]])
    error = trajectory_error(true, true)
    assert error.rmse == pytest.approx(0, abs=1e-12)
    assert error.poses == 4
    off = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]])
    error = trajectory_error(true + off, true)
    assert error.median <= error.largest
    assert 0 < error.mean <= error.rmse <= 0.1 + 1e-9


@pytest.mark.parametrize(
    ("estimated", "true", "say"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "alignment needs three"),
        (np.zeros((5, 3)), np.ones((5, 3)), "same position"),
        (np.zeros((5, 3)), np.ones((4, 3)), "shape"),
    ],
)
def test_what_cannot_be_aligned(estimated, true, say):
    with pytest.raises(ValueError, match=say):
        trajectory_error(estimated, true)
