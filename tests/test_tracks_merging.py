"""Duplicates of a landmark merge; neighbours and outliers do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protomark.geometry.colmap import ColmapModel
from protomark.geometry.triangulation import reprojection_residuals
from protomark.tracks.merging import merge
from protomark.tracks.scene import Scene
from tracks_scene import PINHOLE, poses

PIXEL = 2 / 300  # at the plane, 2 in front of cameras with a focal length of 300


def scene(*landmarks: tuple[NDArray[np.float64], list[int]]) -> Scene:
    """Landmarks at these positions, each seen exactly by the listed keyframes."""
    world = poses(8)
    rows = sorted((k, label) for label, (_, seen) in enumerate(landmarks) for k in seen)
    keyframe = np.array([k for k, _ in rows])
    labels = np.array([label for _, label in rows])
    positions = np.array([place for place, _ in landmarks])
    rays, _ = reprojection_residuals(positions[labels], world[keyframe], np.zeros((len(rows), 2)))
    counts = np.bincount(keyframe, minlength=8)
    names = [str(i) for i in range(8)]
    return Scene(
        model=ColmapModel({1: PINHOLE}, names, np.arange(8), np.ones(8, np.int32), world, []),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        keyframe=keyframe,
        keypoints=(rays * 300 + (160, 120)).astype(np.float32),
        rays=rays,
        focal=np.full(len(rows), 300.0),
        descriptors=np.zeros((len(rows), 32), np.uint8),
        labels=labels,
        positions=positions,
    )


ORIGIN = np.zeros(3)


def right(pixels: float) -> NDArray[np.float64]:
    return np.array([pixels * PIXEL, 0.0, 0.0])


def test_a_chain_of_doubles_becomes_one() -> None:
    s = scene((ORIGIN, [0, 1]), (right(0.5), [2, 3]), (right(-0.5), [4, 5]), (right(0.2), [6, 7]))
    merged = merge(s, np.array([[0, 1], [2, 1], [3, 2], [1, 0]]), 3.0)
    assert merged == 3
    assert s.labels.tolist() == [0] * 8
    assert np.linalg.norm(s.positions[0] - right(0.05)) < 0.3 * PIXEL


def test_shared_keyframe_keeps_the_better_keypoint() -> None:
    s = scene((ORIGIN, [0, 1, 2, 4, 6, 7]), (right(1.5), [4, 5]))
    assert merge(s, np.array([[0, 1]]), 3.0) == 1
    four = s.labels[s.keyframe == 4]
    assert sorted(four.tolist()) == [-1, 0]
    # The merged position lies nearer to the landmark that had more observations.
    assert four[0] == 0
    assert s.labels[s.keyframe == 5].tolist() == [0]


def test_neighbours_that_are_seen_together_stay_two() -> None:
    s = scene((ORIGIN, [0, 1, 2]), (right(2.8), [2, 3, 4]))
    before = s.labels.copy()
    assert merge(s, np.array([[0, 1]] * 5), 3.0) == 0
    assert np.array_equal(s.labels, before)


def test_landmarks_further_apart_than_the_error_stay_two() -> None:
    s = scene((ORIGIN, [0, 1, 2]), (right(5), [3, 4, 5]))
    assert merge(s, np.array([[0, 1]]), 3.0) == 0
    assert s.labels.max() == 1


def test_what_does_not_fit_one_position_is_left_as_it_was() -> None:
    # Close in the views of the first, but at another depth: wide views tell them apart.
    s = scene((ORIGIN, [3, 4]), (np.array([0.0, 0.0, 0.06]), [0, 7]))
    before, places = s.labels.copy(), s.positions.copy()
    assert merge(s, np.array([[0, 1]]), 0.5) == 0
    assert np.array_equal(s.labels, before)
    assert np.array_equal(s.positions, places)


def test_votes_for_a_landmark_itself_or_none_do_nothing() -> None:
    s = scene((ORIGIN, [0, 1]), (right(1), [2, 3]))
    assert merge(s, np.array([[0, 0]]), 3.0) == 0
    assert merge(s, np.zeros((0, 2), np.int64), 3.0) == 0
