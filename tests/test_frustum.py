"""Landmarks visible from an uncertain pose, a superset of those visible from any pose in it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation_scene import CAMERA, looking_inwards
from protomark.geometry.camera import Camera
from protomark.geometry.pose import (
    camera_centers,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from protomark.localization import PosePrior
from protomark.localization.prior import visible
from tracks_scene import DISTORTED, PINHOLE, quaternion

FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0))


@given(
    seed=st.integers(0, 2**32 - 1),
    camera=st.sampled_from([CAMERA, PINHOLE, DISTORTED, FISHEYE]),
    distance=st.floats(0, 3),
    degrees=st.floats(0, 60),
)
def test_what_an_allowed_pose_sees_is_visible(
    seed: int, camera: Camera, distance: float, degrees: float
) -> None:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-8, 8, (500, 3))
    prior = looking_inwards(rng.uniform(0, 6))
    axis, shift = rng.normal(size=(2, 3))
    turn = cv2.Rodrigues(np.radians(degrees) * 0.999 * axis / np.linalg.norm(axis))[0]
    rotation = turn @ prior[:, :3]
    where = camera_centers(prior) + distance * 0.999 * shift / np.linalg.norm(shift)
    true = np.column_stack([rotation, -rotation @ where])
    pixels = camera.project(transform(true, positions))
    # COLMAP's distortions are not one to one: points far outside may fall into the image again.
    local = positions @ true[:, :3].T + true[:, 3]
    inside = (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1)
    inside &= (np.abs(local[:, :2]) < 0.7 * local[:, 2:]).all(1)
    found = visible(PosePrior(prior, distance, degrees), camera, positions)
    assert found[inside].all()


def test_what_is_far_outside_is_not_visible() -> None:
    prior = PosePrior(np.eye(3, 4), 0.1, 5)
    positions = np.array([[0, 0, 5], [0, 0, -5], [20, 0, 5], [0.05, 0, 0], [np.nan] * 3, [3, 0, 5]])
    # The last is 31 degrees to the side: 28 are in the image, 5 + 1 more are allowed.
    assert visible(prior, PINHOLE, positions).tolist() == [True, False, False, True, False, True]
    assert not visible(PosePrior(np.eye(3, 4), 0, 0), PINHOLE, positions[5:]).any()


@pytest.mark.parametrize(("distance", "degrees"), [(-1, 0), (0, -1), (np.nan, 0), (0, np.nan)])
def test_priors_that_are_none(distance: float, degrees: float) -> None:
    with pytest.raises(ValueError, match="must be 0 or more"):
        PosePrior(np.eye(3, 4), distance, degrees)
    with pytest.raises(ValueError, match="finite"):
        PosePrior(np.full((3, 4), np.nan), 1, 1)


@given(st.tuples(*[st.floats(-4, 4)] * 3))
def test_rotations_round_trip(axis: tuple[float, ...]) -> None:
    rotation = cv2.Rodrigues(np.array(axis))[0]
    assert rotation_from_quaternion(quaternion_from_rotation(rotation)) == pytest.approx(
        rotation, abs=1e-9
    )
    if np.trace(rotation) > 0:
        assert quaternion_from_rotation(rotation) == pytest.approx(quaternion(rotation), abs=1e-9)
