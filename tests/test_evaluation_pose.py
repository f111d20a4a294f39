"""Poses from matches, right matches and found poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation_scene import CAMERA, looking_inwards, radial_pixels, ring_scene
from protomark.baselines.binary import unaggregated
from protomark.baselines.support import Support
from protomark.evaluation.frames import (
    FrameMatches,
    LocalizedFrame,
    QueryFrame,
    localize_frame,
    right_matches,
    scene_depth,
    select_matches,
)
from protomark.evaluation.methods import choose_methods, method_choices
from protomark.evaluation.protocol import split
from protomark.evaluation.run import EvaluationOptions, draw_frames, evaluate
from protomark.geometry.absolute_pose import pose_covariance, refine_pose
from protomark.geometry.camera import Camera
from protomark.geometry.pose import pose_error, transform


def test_projection_is_colmaps() -> None:
    camera_points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 5), (50, 3))
    world = np.eye(3, 4)
    assert CAMERA.project(transform(world, camera_points)) == pytest.approx(
        radial_pixels(camera_points), abs=1e-6
    )
    behind = camera_points * (1, 1, -1)
    assert np.isinf(CAMERA.project(transform(world, behind))).all()


@given(
    angle=st.floats(0, 180),
    axis=st.sampled_from(list(np.eye(3))),
    shift=st.tuples(*[st.floats(-10, 10)] * 3),
    turn=st.floats(-3, 3),
)
def test_pose_error(
    angle: float, axis: np.ndarray, shift: tuple[float, float, float], turn: float
) -> None:
    true = looking_inwards(turn)
    cross = np.cross(np.eye(3), axis)
    radians = np.radians(angle)
    rotation = np.eye(3) + np.sin(radians) * cross + (1 - np.cos(radians)) * cross @ cross
    turned = rotation @ true[:, :3]
    centre = -true[:, :3].T @ true[:, 3] + shift
    estimate = np.concatenate([turned, (-turned @ centre)[:, None]], axis=1)
    distance, degrees = pose_error(estimate, true)
    assert distance == pytest.approx(np.linalg.norm(shift), abs=1e-6)
    assert degrees == pytest.approx(angle, abs=1e-5)


def test_found_needs_both_place_and_direction() -> None:
    inliers = np.ones(4, bool)
    near, straight = 0.01 * 5, 2.0
    assert LocalizedFrame(np.eye(3, 4), near, straight, inliers).found(5)
    assert not LocalizedFrame(np.eye(3, 4), near + 1e-6, straight, inliers).found(5)
    assert not LocalizedFrame(np.eye(3, 4), near, straight + 1e-6, inliers).found(5)
    assert not LocalizedFrame(None, np.inf, np.inf, inliers).found(5)


def test_acceptance_ranks_by_ratio_and_keeps_each_landmark_once() -> None:
    landmarks = np.array([[7, 1], [7, 2], [3, 7], [-1, -1], [4, 3], [5, -1], [6, 1], [8, 1]])
    distances = np.array(
        [[4, 8], [1, 8], [3, 10], [np.inf, np.inf], [5, 5], [9, np.inf], [0, 0], [0, 7]],
        dtype=np.float32,
    )
    every = select_matches(landmarks, distances, share=1)
    # Ratios: 0.5 (loses landmark 7), 0.125, 0.3, none, 1, 0 at distance 9, 1 (0 / 0), 0 at 0.
    assert every.keypoints.tolist() == [7, 5, 1, 2, 6, 4]
    assert every.landmarks.tolist() == [8, 5, 7, 3, 6, 4]
    quarter = select_matches(landmarks, distances)
    assert quarter.keypoints.tolist() == [7, 5]
    nothing = select_matches(landmarks[:0], distances[:0])
    assert len(nothing.keypoints) == 0


def test_right_matches() -> None:
    tracks = ring_scene()
    frame = QueryFrame.of(tracks, 3)
    own = np.flatnonzero(frame.landmarks >= 0)[:6]
    landmarks = frame.landmarks[own].copy()
    landmarks[3:] = np.roll(frame.landmarks[own], 1)[3:]
    matches = FrameMatches(own, landmarks)
    positions = tracks.positions_of(landmarks)
    assert right_matches(frame, matches, positions).tolist() == [True] * 3 + [False] * 3
    # The track is not known to the keypoint, but the landmark projects onto it.
    unknown = replace(frame, landmarks=np.full_like(frame.landmarks, -1))
    assert right_matches(unknown, matches, positions).tolist() == [True] * 3 + [False] * 3
    # The tolerance is half a percent of 640 pixels.
    off = replace(unknown, keypoints=frame.keypoints + np.array([0, 3.2 + 2.5]))
    assert not right_matches(off, matches, positions).any()


@pytest.mark.parametrize("wrong", [0.0, 0.6])
def test_a_pose_is_found_among_wrong_matches(wrong: float) -> None:
    tracks = ring_scene()
    depth = scene_depth(tracks)
    rng = np.random.default_rng(0)
    for keyframe in range(5):
        frame = QueryFrame.of(tracks, keyframe)
        keypoints = np.flatnonzero(frame.landmarks >= 0)
        landmarks = frame.landmarks[keypoints].copy()
        spoilt = rng.random(len(landmarks)) < wrong
        landmarks[spoilt] = rng.permutation(landmarks[spoilt])
        matches = FrameMatches(keypoints, landmarks)
        found = localize_frame(frame, matches, tracks.positions_of(landmarks))
        assert found.found(depth)
        # Half a pixel of noise at 500 pixels focal length: a thousandth of the depth.
        assert found.position_error < 0.005 * depth
        assert found.inliers[~spoilt].mean() > 0.95


def test_no_pose_without_enough_matches() -> None:
    tracks = ring_scene()
    frame = QueryFrame.of(tracks, 0)
    three = np.flatnonzero(frame.landmarks >= 0)[:3]
    matches = FrameMatches(three, frame.landmarks[three])
    found = localize_frame(frame, matches, tracks.positions_of(matches.landmarks))
    assert found.cam_from_world is None
    assert not found.found(1e9)


def test_no_pose_from_random_matches() -> None:
    tracks = ring_scene()
    rng = np.random.default_rng(0)
    frame = QueryFrame.of(tracks, 0)
    keypoints = np.arange(100)
    landmarks = rng.permutation(400)[:100]
    found = localize_frame(
        frame, FrameMatches(keypoints, landmarks), tracks.positions_of(landmarks)
    )
    assert not found.found(scene_depth(tracks))


def test_scene_depth_against_every_observation() -> None:
    tracks = ring_scene(keyframes=5)
    depths = [
        float(tracks.cam_from_world[i, 2, :3] @ tracks.landmark_positions[j])
        + tracks.cam_from_world[i, 2, 3]
        for i, j in zip(tracks.keyframe_of_keypoint, tracks.landmark_of_keypoint, strict=True)
        if j >= 0
    ]
    assert scene_depth(tracks) == pytest.approx(np.median(depths))


def test_frames_are_whole_query_keyframes() -> None:
    tracks = ring_scene(keyframes=40)
    part = split(tracks, 0)
    assert len(draw_frames(tracks, part, 100)) == len(part.query_keyframes) == 4
    some = draw_frames(tracks, part, 2)
    assert len(some) == 2
    for frame in some:
        index = next(
            i
            for i in part.query_keyframes
            if (tracks.cam_from_world[i] == frame.cam_from_world).all()
        )
        assert len(frame.keypoints) == np.diff(tracks.offsets)[index]
        assert (frame.landmarks == -1).sum() == 40


@pytest.mark.parametrize(("common", "drawn"), [(19, False), (20, True)])
def test_frames_that_see_hardly_any_of_the_map_are_not_drawn(common: int, drawn: bool) -> None:
    tracks = ring_scene()
    part = split(tracks, 0, "later")
    first = tracks.keypoints_of(int(part.query_keyframes[0]))
    in_map = np.unique(tracks.landmark_of_keypoint[part.support_rows])
    landmark = tracks.landmark_of_keypoint.copy()
    seen = np.flatnonzero(np.isin(landmark[first], in_map))
    landmark[first][seen[common:]] = -1
    frames = draw_frames(replace(tracks, landmark_of_keypoint=landmark), part, 100)
    assert len(frames) == len(part.query_keyframes) - (not drawn)


def test_figures_of_a_method_against_one_query_at_a_time() -> None:
    tracks = ring_scene(noise=0.25)
    chosen = choose_methods(method_choices(), ["unaggregated", "pca-8"])
    result = evaluate(tracks, "ring", chosen, EvaluationOptions(seeds=[0], threads=2))
    part = split(tracks, 0)
    support = Support(
        tracks.landmark_of_keypoint[part.support_rows], tracks.descriptors[part.support_rows]
    )
    method = unaggregated(support)
    right = sum(
        int(method.match(tracks.descriptors[row : row + 1])[0][0, 0])
        == tracks.landmark_of_keypoint[row]
        for row in part.query_rows
    )
    whole, small = result.methods
    assert whole.precision == [right / len(part.query_rows)]
    assert 0 < small.precision[0] < whole.precision[0] < 1

    accepted = good = found = landmarks = 0
    for keyframe in part.query_keyframes:
        frame = QueryFrame.of(tracks, int(keyframe))
        answers, distances = method.match(frame.descriptors)
        matches = select_matches(answers, distances)
        positions = tracks.positions_of(matches.landmarks)
        near = radial_pixels(
            tracks.landmark_positions[answers[:, 0]] @ frame.cam_from_world[:, :3].T
            + frame.cam_from_world[:, 3]
        )
        error = np.linalg.norm(near - frame.keypoints, axis=1)
        right = (frame.landmarks == answers[:, 0]) | (error <= 3.2)
        ratio = distances[:, 0] / distances[:, 1]
        for landmark in np.unique(answers[:, 0]):
            asked = np.flatnonzero(answers[:, 0] == landmark)
            landmarks += bool(right[asked[np.lexsort((distances[asked, 0], ratio[asked]))[0]]])
        accepted += len(matches.keypoints)
        good += int(right_matches(frame, matches, positions).sum())
        found += localize_frame(frame, matches, positions).found(result.scene_depth)
    assert (whole.frames, whole.found) == (2, found)
    assert (whole.selected, whole.right) == (accepted, good)
    assert good < whole.landmarks_found == landmarks
    assert found == 2


def test_covariance_is_the_spread_of_repeated_poses() -> None:
    rng = np.random.default_rng(0)
    camera = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    true = np.column_stack([cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0], [0.2, -0.1, 0.5]])
    points = rng.uniform((-2, -2, 4), (2, 2, 9), (60, 3))
    world = (points - true[:, 3]) @ true[:, :3]
    steps, covariances = [], []
    for _ in range(400):
        pixels = camera.project(points) + rng.normal(0, 0.8, (60, 2))
        pose, _ = refine_pose(true, pixels, world, camera, 20.0)
        turn = cv2.Rodrigues(pose[:, :3] @ true[:, :3].T)[0].ravel()
        steps.append([*turn, *(pose[:, 3] - cv2.Rodrigues(turn)[0] @ true[:, 3])])
        covariances.append(pose_covariance(pose, pixels, world, camera))
    spread, expected = np.cov(np.array(steps).T), np.mean(covariances, axis=0)
    # In units of the expected spread the differences are normal: squared norms average 6.
    whitened = np.linalg.solve(np.linalg.cholesky(expected), np.array(steps).T)
    assert (whitened**2).sum(0).mean() == pytest.approx(6, rel=0.15)
    np.testing.assert_allclose(np.diag(spread), np.diag(expected), rtol=0.3)
    assert pose_covariance(true, pixels[:3], world[:3], camera) is None
    # On one ray all points look alike.
    same = np.tile(world[:1], (10, 1))
    assert pose_covariance(true, camera.project(np.tile(points[:1], (10, 1))), same, camera) is None
