"""Structure, culling, merging and loops on simulated frames with true poses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import protomark as pm
from conftest import random_layers
from mapping_scene import walk
from protomark.geometry.absolute_pose import refine_pose
from protomark.geometry.pose import camera_centers, transform
from protomark.mapping import loop, merging
from protomark.mapping.adjustment import adjust, adjust_global_bundle
from protomark.mapping.culling import cull
from protomark.mapping.frame import Frame
from protomark.mapping.memory import Prototypes
from protomark.mapping.options import MappingOptions
from protomark.mapping.prediction import predict
from protomark.mapping.structure import Structure
from protomark.mapping.triangulation import update_prototypes
from tracks_scene import PINHOLE

ENCODER = pm.Encoder(
    random_layers([64, 24, 12]), dims=[12], name="tiny", descriptor="test", scale=0.02
)
OPTIONS = MappingOptions(max_error=0.01)
POINTS = 60


def scene(noise: float = 0.0, seed: int = 0) -> tuple[Structure, Prototypes]:
    """Eight frames that see the same points; every frame has other descriptors."""
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-0.6, 0.5, POINTS), rng.uniform(-0.5, 0.5, POINTS), rng.uniform(2, 3, POINTS)]
    )
    structure, memory = Structure({1: PINHOLE}, OPTIONS), Prototypes(ENCODER, 12)
    ids = structure.create(points)
    for i, pose in enumerate(walk(8)):
        pixels = PINHOLE.project(transform(pose, points)) + noise * rng.normal(size=(POINTS, 2))
        descriptors = rng.integers(0, 256, (POINTS, 8), np.uint8)
        frame = Frame(
            index=i,
            name=str(i),
            time=float(i),
            camera_id=1,
            pose=pose.copy(),
            keypoints=pixels.astype(np.float32),
            landmarks=np.full(POINTS, -1, np.int64),
            rays=PINHOLE.rays(pixels),
            sigma=np.ones(POINTS),
            descriptors=descriptors,
            encoded=memory.encode(descriptors),
        )
        structure.frames.append(frame)
        structure.observe(frame, np.arange(POINTS), ids)
        update_prototypes(memory, frame, np.arange(POINTS))
    return structure, memory


def check_memory(structure: Structure, memory: Prototypes) -> None:
    """The memory contains exactly the observations of the frames."""
    expected = pm.PrototypeMap(ENCODER, 12)
    for frame in structure.frames:
        expected.add_codes(frame.seen, frame.codes[frame.observed])
    ids = expected.ids
    np.testing.assert_array_equal(memory.map.ids, ids)
    np.testing.assert_array_equal(memory.map.counts(ids), expected.counts(ids))
    np.testing.assert_array_equal(memory.map.prototypes(ids), expected.prototypes(ids))


def test_ids_count_up_from_one_and_are_never_used_again() -> None:
    structure, _ = scene()
    assert structure.ids.tolist() == list(range(1, POINTS + 1))
    structure.remove(np.array([2, POINTS]))
    assert structure.create(np.zeros((1, 3))).tolist() == [POINTS + 1]
    assert all(2 not in frame.landmarks for frame in structure.frames)


def test_visible_is_what_projects_into_the_image_from_where_it_was_seen() -> None:
    structure, _ = scene()
    pose = walk(8)[3]
    ids, pixels = structure.visible(pose, 1)
    want = PINHOLE.project(transform(pose, structure.positions[structure.ids]))
    inside = ((want > 0) & (want < [320, 240])).all(1)
    np.testing.assert_array_equal(ids, structure.ids[inside])
    np.testing.assert_allclose(pixels, want[inside], atol=1e-9)
    # From the other side nothing looks as it did.
    behind = np.column_stack([np.diag([-1.0, 1, -1]), [0, 0, 5.0]])
    assert not len(structure.visible(behind, 1)[0])


def test_culling_takes_observations_back_exactly_and_weak_landmarks_out() -> None:
    structure, memory = scene()
    off = structure.frames[2]
    off.rays[4] += 0.1
    for frame in structure.frames[1:]:
        memory.subtract(frame.landmarks[7:8], frame.encoded[7:8])
        frame.landmarks[7] = -1
    gone = cull(structure, memory, list(range(8)))
    assert gone == 1
    assert off.landmarks[4] == -1
    assert 8 not in structure.ids
    check_memory(structure, memory)


def test_landmarks_seen_twice_go_when_the_window_has_left_them_behind() -> None:
    structure, memory = scene()
    structure.born[:] = 1
    for frame in structure.frames[2:]:
        memory.subtract(frame.landmarks[:5], frame.encoded[:5])
        frame.landmarks[:5] = -1
    assert cull(structure, memory, list(range(8))) == 0
    for frame in structure.frames[:2]:
        frame.descriptors = frame.encoded = None
    assert cull(structure, memory, list(range(8))) == 5
    assert structure.ids.tolist() == list(range(6, POINTS + 1))


def test_merging_joins_what_no_frame_tells_apart_and_one_position_fits() -> None:
    structure, memory = scene()
    double = structure.create(structure.positions[[3, 5]] + 1e-4)
    for frame in structure.frames[4:]:
        for row, new in zip((2, 4), double, strict=True):
            memory.subtract(frame.landmarks[[row]], frame.encoded[[row]])
            frame.landmarks[row] = -1
            structure.observe(frame, np.array([row]), np.array([new]))
            update_prototypes(memory, frame, np.array([row]))
    a, b = double.tolist()
    pairs = [(3, a), (b, 5), (10, 11), (20, 20)]
    assert merging.merge_duplicates(structure, memory, pairs) == 2
    assert all(frame.landmarks.tolist() == list(range(1, POINTS + 1)) for frame in structure.frames)
    check_memory(structure, memory)
    assert (memory.map.counts(memory.map.ids) == 8).all()
    # Two places that no frame shows together are still two.
    far = structure.create(structure.positions[[30]] + [[0.3, 0, 0]])
    for frame in structure.frames[4:]:
        frame.landmarks[29] = -1
        frame.rays[29] = PINHOLE.rays(
            PINHOLE.project(transform(frame.pose, structure.positions[far]))
        )[0]
        structure.observe(frame, np.array([29]), far)
    assert merging.merge_duplicates(structure, memory, [(30, int(far[0]))]) == 0


def test_adjustment_finds_back_to_what_was_seen() -> None:
    structure, _ = scene()
    rng = np.random.default_rng(1)
    for frame in structure.frames[2:]:
        turn = cv2.Rodrigues(0.01 * rng.normal(size=3))[0]
        frame.pose = np.column_stack([turn @ frame.pose[:, :3], frame.pose[:, 3]])
        frame.pose[:, 3] += 0.01 * rng.normal(size=3)
    structure.positions[1:] += 0.02 * rng.normal(size=(POINTS, 3))
    adjust(structure, list(range(2, 8)), [0, 1], iterations=50)
    for frame, pose in zip(structure.frames, walk(8), strict=True):
        np.testing.assert_allclose(frame.pose, pose, atol=1e-4)
    assert structure.errors(structure.observations()).max() < 0.01


def test_fixed_poses_move_landmarks_only() -> None:
    structure, _ = scene()
    true = structure.positions.copy()
    structure.positions[1:] += 0.02
    adjust_global_bundle(structure, poses=False)
    np.testing.assert_allclose(structure.positions[1:], true[1:], atol=1e-4)
    for frame, pose in zip(structure.frames, walk(8), strict=True):
        np.testing.assert_array_equal(frame.pose, pose)


def test_drift_is_spread_over_the_frames_since_the_place_was_seen() -> None:
    structure, _ = scene()
    newest, old = structure.frames[-1], np.arange(1, 21)
    # Old landmarks: 1 to 20, which the first three frames see; all others are new.
    for i, frame in enumerate(structure.frames):
        frame.landmarks[:20] = old if i < 3 else -1
        frame.landmarks[20:] = frame.landmarks[20:] if i >= 3 else -1
    for i, frame in enumerate(structure.frames[3:], 1):
        turn = cv2.Rodrigues(i / 5 * np.array([0.02, -0.1, 0.03]))[0]
        moved = camera_centers(frame.pose) + i / 5 * np.array([0.3, -0.1, 0.2])
        frame.pose[:, :3] = frame.pose[:, :3] @ turn.T
        frame.pose[:, 3] = -frame.pose[:, :3] @ moved
    true = walk(8)
    before = [
        np.linalg.norm(camera_centers(f.pose) - camera_centers(true[f.index]))
        for f in structure.frames
    ]
    loop._correct_drift(structure, 7, true[7], np.arange(20), old)
    np.testing.assert_allclose(newest.pose, true[7], atol=1e-9)
    for frame in structure.frames[:3]:
        np.testing.assert_array_equal(frame.pose, true[frame.index])
    for frame in structure.frames[3:]:
        off = np.linalg.norm(camera_centers(frame.pose) - camera_centers(true[frame.index]))
        assert off < 0.2 * before[frame.index]


def test_prediction_goes_on_as_the_camera_moved_on_either_side() -> None:
    structure, _ = scene()
    turn = cv2.Rodrigues(np.array([0.01, 0.04, -0.02]))[0]
    motion = np.vstack([np.column_stack([turn, [0.1, -0.02, 0.05]]), [0, 0, 0, 1]])
    pose = np.eye(4)
    for frame in structure.frames:
        frame.pose = pose[:3]
        pose = motion @ pose
    np.testing.assert_allclose(predict(structure.frames, 8, 1), pose[:3], atol=1e-12)
    backward = (np.linalg.inv(motion))[:3]
    np.testing.assert_allclose(predict(structure.frames, -1, 1), backward, atol=1e-12)
    inside = [frame for frame in structure.frames if frame.index != 4]
    np.testing.assert_allclose(predict(inside, 4, 1), structure.frames[4].pose, atol=1e-12)
    # Across gaps, where frames are missing before it or between the two that are nearest.
    gaps = [frame for frame in structure.frames if frame.index in (1, 3, 6)]
    for index in (0, 4, 5, 7):
        wanted = structure.frames[index].pose
        np.testing.assert_allclose(predict(gaps, index, 1), wanted, atol=1e-12)
    np.testing.assert_array_equal(predict(structure.frames[:1], 2, 1), np.eye(3, 4))
    assert predict(structure.frames, 20, 1) is None
    assert predict(structure.frames, 8, 2) is None


def test_landmarks_are_less_certain_the_further_from_their_rays_they_are_seen() -> None:
    structure, _ = scene()
    structure.frames = structure.frames[:2]
    structure.recompute_views()
    ids = structure.ids
    one, two = (frame.pose for frame in structure.frames)
    # Along one of two rays that are an angle apart, it is half of that off their middle, and the
    # depth's variance shows half as much as a keypoint's.
    np.testing.assert_allclose(structure.weights(one, ids), 2 / 3, rtol=1e-3)
    middle = one.copy()
    middle[:, 3] = -middle[:, :3] @ (camera_centers(one) + camera_centers(two)) / 2
    assert (structure.weights(middle, ids) > 0.999).all()
    far = walk(8)[7]
    assert (structure.weights(far, ids) < 0.03).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_a_refined_pose_is_the_one_that_certain_landmarks_give(weighted: bool) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.6, -0.5, 2], [0.5, 0.5, 3], (POINTS, 3))
    pose = walk(8)[3]
    pixels = PINHOLE.project(transform(pose, points))
    weights = np.ones(POINTS)
    if weighted:
        # A third, on one side, has depths that all are wrong the same way.
        wrong = np.argsort(points[:, 0])[: POINTS // 3]
        points[wrong, 2] *= 1.2
        weights[wrong] = 1e-6
    start = pose.copy()
    start[:, 3] += [0.02, -0.03, 0.05]
    found, inliers = refine_pose(start, pixels, points, PINHOLE, 2.5, weights)
    np.testing.assert_allclose(found, pose, atol=1e-4)
    assert inliers.all()
