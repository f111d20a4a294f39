"""Tracks of a rendered plane, on which all landmarks must lie."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from protomark.features.descriptors import DESCRIPTORS
from protomark.features.extractor import Extractor
from protomark.geometry.colmap import ColmapModel, new_reconstruction, pycolmap
from protomark.geometry.pose import camera_centers
from protomark.tracks.extract import (
    SequenceFolder,
    TracksOptions,
    extract,
    find_sequence,
    provenance,
)
from protomark.tracks.file import Tracks
from protomark.tracks.make import make_tracks
from protomark.tracks.summary import reprojection_errors, summarise
from protomark.tracks.triangulation import refine_poses
from tracks_scene import DISTORTED, PINHOLE, poses, texture, write_model, write_sequence


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("scene") / "plane")


@pytest.fixture(scope="module")
def orb(sequence: Path) -> Tracks:
    return extract(find_sequence(sequence), TracksOptions("orb", max_keypoints=600))


def spread_on_plane(tracks: Tracks) -> np.ndarray:
    """Distance of each observation from its landmark's mean, measured on the true plane z = 0."""

    rows = tracks.observations
    keyframe = tracks.keyframe_of_keypoint[rows]
    pose = poses(len(tracks.keyframe_names))[keyframe]
    ray = tracks.cameras[1].rays(tracks.keypoints[rows])
    direction = np.einsum("nji,nj->ni", pose[:, :, :3], np.column_stack([ray, np.ones(len(ray))]))
    center = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    hit = (center - direction * (center[:, 2] / direction[:, 2])[:, None])[:, :2]
    label = tracks.landmark_of_keypoint[rows]
    count = np.bincount(label)
    mean = np.column_stack([np.bincount(label, hit[:, k]) / count for k in (0, 1)])
    return np.linalg.norm(hit - mean[label], axis=1)


def check_labels(tracks: Tracks) -> None:
    """Checks that hold for every tracks file."""
    assert tracks.landmark_ids.tolist() == list(range(len(tracks.landmark_ids)))
    rows = tracks.observations
    pairs = np.column_stack([tracks.landmark_of_keypoint[rows], tracks.keyframe_of_keypoint[rows]])
    assert len(np.unique(pairs, axis=0)) == len(pairs), "a landmark twice in one keyframe"
    assert np.bincount(tracks.landmark_of_keypoint[rows]).min() >= 3
    first = np.unique(tracks.landmark_of_keypoint[rows], return_index=True)[1]
    assert (np.diff(first) > 0).all(), "landmarks are numbered by their first keypoint"


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_every_descriptor_gives_landmarks_on_the_plane(sequence: Path, name: str) -> None:
    tracks = extract(find_sequence(sequence), TracksOptions(name, max_keypoints=400))
    check_labels(tracks)
    assert tracks.bits == DESCRIPTORS[name].bits
    assert len(tracks.landmark_ids) > 50
    assert np.median(np.abs(tracks.landmark_positions[:, 2])) < 0.01
    # One pixel is 1/150 of a unit at the plane.
    assert np.percentile(spread_on_plane(tracks), 99) < 3 / 150
    assert reprojection_errors(tracks).max() < 3.2
    assert np.diff(tracks.offsets).max() <= 400


def test_strong_distortion(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "bent", DISTORTED, count=6)
    tracks = extract(find_sequence(folder), TracksOptions("orb", max_keypoints=500))
    check_labels(tracks)
    assert len(tracks.landmark_ids) > 50
    assert np.median(np.abs(tracks.landmark_positions[:, 2])) < 0.01
    assert np.percentile(spread_on_plane(tracks), 99) < 3 / 130


def test_same_tracks_on_any_number_of_threads(sequence: Path, orb: Tracks) -> None:
    again = extract(find_sequence(sequence), TracksOptions("orb", max_keypoints=600), threads=2)
    for name, value in vars(orb).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, getattr(again, name)), name
    assert again.info == orb.info


def test_akaze_at_once_finds_what_threshold_after_threshold_finds() -> None:
    rich, poor = texture(480), cv2.convertScaleAbs(texture(480, 5), alpha=0.15, beta=100)
    at_once, plain = Extractor("akaze", 500), Extractor("akaze", 500)
    plain._akaze = None
    before = []
    for image in (rich, poor, poor, rich, rich, np.zeros((480, 480), np.uint8)):
        found, expected = at_once(image), plain(image)
        for name, value in vars(expected).items():
            np.testing.assert_array_equal(getattr(found, name), value)
        before.append(at_once._high_contrast)
    assert before == [True, False, False, True, True, False], "both ways were to be taken"


def test_keyframes_are_in_order_of_capture(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "long", count=11)
    tracks = extract(find_sequence(folder), TracksOptions("orb", max_keypoints=200))
    assert tracks.keyframe_names == [f"img{i}.png" for i in range(1, 12)]


def moved_sequence(folder: Path, sequence: Path, cam_from_world: NDArray[np.float64]) -> Path:
    shutil.copytree(sequence / "images", folder / "images")
    names = [f"img{i}.png" for i in range(1, 9)]
    write_model(folder / "sparse", PINHOLE, names, cam_from_world)
    return folder


def test_rough_poses_are_noticed_and_refined(sequence: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rough = poses(8)
    for pose in rough:
        turn = cv2.Rodrigues(rng.normal(0, 0.008, 3))[0]
        pose[:] = turn @ pose
    source = find_sequence(moved_sequence(tmp_path, sequence, rough))
    kept = extract(source, TracksOptions("orb", max_keypoints=500, refine_poses="no"))
    refined = extract(source, TracksOptions("orb", max_keypoints=500))
    assert not kept.info["poses_refined"]
    assert refined.info["poses_refined"]
    assert np.allclose(kept.cam_from_world, rough, atol=1e-12)
    assert reprojection_errors(refined).mean() < 0.6 * reprojection_errors(kept).mean()
    assert len(refined.observations) > 1.2 * len(kept.observations)
    # The world stays the given one: same place and scale, and the plane is flat in it.
    centers = [-p[:, :3].T @ p[:, 3] for p in refined.cam_from_world]
    true = [-p[:, :3].T @ p[:, 3] for p in poses(8)]
    assert np.linalg.norm(np.subtract(centers, true), axis=1).max() < 0.08
    points = refined.landmark_positions - refined.landmark_positions.mean(0)
    assert np.linalg.svd(points)[1][2] / np.sqrt(len(points)) < 0.03


@pytest.mark.parametrize("kind", ["camera-to-world", "axes", "names"])
def test_poses_of_something_else_are_refused(kind: str, sequence: Path, tmp_path: Path) -> None:
    wrong = poses(8)
    if kind == "camera-to-world":
        turned = wrong[:, :, :3].transpose(0, 2, 1)
        wrong = np.concatenate([turned, camera_centers(wrong)[:, :, None]], axis=2)
    elif kind == "axes":
        wrong = np.diag([1.0, -1.0, -1.0]) @ wrong
    else:
        wrong = wrong[np.random.default_rng(0).permutation(8)]
    source = find_sequence(moved_sequence(tmp_path, sequence, wrong))
    for refine in ("auto", "no"):
        with pytest.raises(ValueError, match=r"do not fit the images.*camera-to-world"):
            extract(source, TracksOptions("orb", max_keypoints=500, refine_poses=refine))


def test_refined_poses_are_dropped_unless_clearly_more_fits(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rough = poses(8)
    rough[4] = np.column_stack([rough[4][:, :3], rough[4][:, 3] + 0.02])
    source = find_sequence(moved_sequence(tmp_path, sequence, rough))
    monkeypatch.setattr("protomark.tracks.extract._ROUGH_POSES", 0.0)

    def worse(given: ColmapModel, *_: Any) -> ColmapModel:
        shifted = given.cam_from_world.copy()
        shifted[1::2, 0, 3] += 0.1
        return replace(given, cam_from_world=shifted)

    monkeypatch.setattr("protomark.tracks.triangulation.refine_poses", worse)
    tracks = extract(source, TracksOptions("orb", max_keypoints=500))
    assert not tracks.info["poses_refined"]
    np.testing.assert_allclose(tracks.cam_from_world, rough, atol=1e-12)


def test_given_positions_are_priors(orb: Tracks) -> None:
    cameras = {1: orb.cameras[1]}
    rng = np.random.default_rng(0)
    given = poses(8)
    given[:, :, 3] += rng.normal(0, 0.03, (8, 3))
    names = [str(i) for i in range(8)]
    numbers = np.arange(1, 9)
    model = ColmapModel(cameras, names, numbers, np.ones(8, np.int32), given, [])
    moved = []
    for error in (0.01, 100.0):
        keypoints = [orb.keypoints[orb.keypoints_of(i)] for i in range(8)]
        images = [(i + 1, names[i], 1, keypoints[i], given[i]) for i in range(8)]
        reconstruction = new_reconstruction(cameras, images)
        labels = [orb.landmark_of_keypoint[orb.keypoints_of(i)] for i in range(8)]
        for landmark, position in zip(orb.landmark_ids, orb.landmark_positions, strict=True):
            track = pycolmap.Track()
            for i in range(8):
                for row in np.flatnonzero(labels[i] == landmark):
                    track.add_element(i + 1, int(row))
            reconstruction.add_point3D(position, track)
        refined = refine_poses(model, reconstruction, error)
        moved.append(float(np.linalg.norm(refined.centers - model.centers, axis=1).mean()))
    assert moved[0] < 0.2 * moved[1]


def test_what_never_moves_is_left_out(sequence: Path, orb: Tracks, tmp_path: Path) -> None:
    still = cv2.resize(texture(300, seed=11), (320, 60))
    shutil.copytree(sequence, tmp_path / "hood")
    for path in (tmp_path / "hood" / "images").iterdir():
        image = cv2.imread(str(path))
        image[180:] = still[:, :, None]
        cv2.imwrite(str(path), image)
    tracks = extract(find_sequence(tmp_path / "hood"), TracksOptions("orb", max_keypoints=500))
    boxes = re.findall(r"x (\d+)-(\d+), y (\d+)-(\d+)", tracks.info["static_region"])
    left, right, top, bottom = np.array(boxes, int).T
    assert left.min() < 60
    assert right.max() > 260
    assert 160 < top.min() < 200 < bottom.max()
    assert orb.info["static_region"] == ""
    assert not tracks.info["poses_refined"]
    observed = tracks.keypoints[tracks.observations]
    assert (observed[:, 1] > 195).mean() < 0.02


def test_exact_poses_are_kept(orb: Tracks) -> None:
    assert not orb.info["poses_refined"]
    assert np.allclose(orb.cam_from_world, poses(8), atol=1e-12)


def test_completion_adds_observations_that_are_right(sequence: Path, orb: Tracks) -> None:
    assert orb.info["observations_completed"] > 0
    # Against a stricter matcher that leaves more to completion, the same points come out.
    strict = extract(find_sequence(sequence), TracksOptions("orb", max_keypoints=600, ratio=0.6))
    assert strict.info["observations_completed"] > orb.info["observations_completed"]
    assert np.percentile(spread_on_plane(strict), 99) < 3 / 150


def test_few_landmarks_are_double(orb: Tracks) -> None:
    xyz = orb.landmark_positions
    near = np.linalg.norm(xyz[:, None] - xyz[None], axis=2) < 1 / 150
    assert (near.sum(1) > 1).mean() < 0.05


def test_file_round_trip(orb: Tracks, tmp_path: Path) -> None:
    path = tmp_path / "plane.orb.safetensors"
    orb.save(path)
    back = Tracks.load(path)
    keypoint = ("keypoints", "sizes", "angles", "responses", "octaves", "descriptors")
    for name in (*keypoint, "landmark_of_keypoint", "landmark_positions"):
        assert np.array_equal(getattr(back, name), getattr(orb, name)), name
    assert back.info == orb.info
    assert back.cameras == orb.cameras
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_keypoints_keep_what_the_detector_says(orb: Tracks) -> None:
    assert len(np.unique(orb.octaves)) > 2
    np.testing.assert_allclose(orb.sizes, 31 * 1.2**orb.octaves, rtol=1e-4)
    assert (orb.angles >= 0).all()
    for i in range(len(orb.keyframe_names)):
        responses = orb.responses[orb.keypoints_of(i)]
        assert responses[-1] > 0
        assert (np.diff(responses) <= 0).all()
        assert len(np.unique(responses)) > len(responses) // 2


def test_max_unlabelled_drops_only_keypoints_without_landmark(sequence: Path, orb: Tracks) -> None:
    settings = TracksOptions("orb", max_keypoints=600, max_unlabelled=7)
    few = extract(find_sequence(sequence), settings)
    assert np.array_equal(few.descriptors[few.observations], orb.descriptors[orb.observations])
    for i in range(len(few.keyframe_names)):
        rows, all_rows = few.keypoints_of(i), orb.keypoints_of(i)
        strong = np.sort(orb.responses[all_rows][orb.landmark_of_keypoint[all_rows] < 0])[-7:]
        kept = few.responses[rows][few.landmark_of_keypoint[rows] < 0]
        assert np.array_equal(np.sort(kept), strong)


def test_summary_counts_add_up(orb: Tracks) -> None:
    summary = summarise(orb)
    assert sum(summary["track_length_histogram"].values()) == summary["landmarks"]
    mean = summary["observations"] / summary["landmarks"]
    assert summary["track_length_mean"] == pytest.approx(mean)
    assert summary["reprojection_error_mean"] == pytest.approx(reprojection_errors(orb).mean())


def test_done_only_with_same_settings_and_input(
    sequence: Path, orb: Tracks, tmp_path: Path
) -> None:
    source, options = find_sequence(sequence), TracksOptions("orb", max_keypoints=600)
    made = make_tracks(source, options, tmp_path)
    assert not made.skipped
    path = made.path
    assert make_tracks(source, options, tmp_path).skipped
    expected = provenance(source, options)
    assert expected == {key: orb.info[key] for key in expected}
    assert provenance(source, replace(options, max_keypoints=601)) != expected
    rough = poses(8)
    rough[3, 0, 3] += 1e-6
    write_model(tmp_path / "moved", PINHOLE, [f"img{i}.png" for i in range(1, 9)], rough)
    moved = SequenceFolder("plane", source.images, tmp_path / "moved")
    assert provenance(moved, options) != expected
    images = shutil.copytree(source.images, tmp_path / "images")
    data = bytearray((images / "img5.png").read_bytes())
    data[100] ^= 1  # another image of the same size
    (images / "img5.png").write_bytes(data)
    assert provenance(replace(source, images=images), options) != expected
    path.write_bytes(path.read_bytes()[:-100])
    assert not make_tracks(source, options, tmp_path).skipped
