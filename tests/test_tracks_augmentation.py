from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from protomark.cli import app
from protomark.evaluation.protocol import split
from protomark.tracks.augmentation import add_augmentations, augment
from protomark.tracks.extract import TracksOptions, extract, find_sequence
from protomark.tracks.file import Tracks
from tracks_scene import PINHOLE, poses, render, texture, write_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("data") / "plane"
    (where / "images").mkdir(parents=True)
    picture, views = texture(), poses(4)
    names = [f"{i}.png" for i in range(len(views))]
    for name, pose in zip(names, views, strict=True):
        cv2.imwrite(str(where / "images" / name), render(pose, PINHOLE, picture))
    write_model(where / "sparse", PINHOLE, names, views)
    return where


@pytest.fixture(scope="module")
def plain(folder: Path) -> Tracks:
    return extract(find_sequence(folder), TracksOptions("orb", max_keypoints=600))


def test_homography_says_where_a_pixel_went() -> None:
    # A bright spot, alone on grey, is where the homography puts it.
    image = np.full((200, 300), 60, np.uint8)
    cv2.circle(image, (170, 80), 4, 255, -1)
    for seed in range(10):
        copy, homography, _, _ = augment(image, np.random.default_rng(seed))
        assert copy.shape == image.shape
        assert copy.dtype == np.uint8
        x, y, w = homography @ [170, 80, 1]
        blurred = cv2.GaussianBlur(copy.astype(np.float32), (0, 0), 3)
        found = np.unravel_index(blurred.argmax(), blurred.shape)
        assert np.hypot(found[1] - x / w, found[0] - y / w) < 3


def test_scale_and_rotation_are_the_homographys() -> None:
    image = np.zeros((200, 300), np.uint8)
    for seed in range(5):
        _, homography, scale, angle = augment(image, np.random.default_rng(seed))
        to = [(homography @ [150 + dx, 100, 1]) for dx in (0, 1)]
        step = to[1][:2] / to[1][2] - to[0][:2] / to[0][2]
        assert np.hypot(*step) == pytest.approx(scale, rel=0.1)
        assert np.degrees(np.arctan2(step[1], step[0])) == pytest.approx(angle, abs=3)


def test_copies_see_the_same_landmarks_at_the_same_places(folder: Path, plain: Tracks) -> None:
    varied = add_augmentations(plain, folder / "images", 2)
    varied.check()
    m, n = len(plain.keyframe_names), len(plain.observations)
    assert varied.keyframe_names[m : m + 2] == ["0.png#1", "0.png#2"]
    assert len(varied.keyframe_names) == 3 * m
    assert len(varied.keypoints) > 1.2 * n
    assert (varied.landmark_of_keypoint >= 0).all()
    # The plain observations come first, unchanged.
    np.testing.assert_array_equal(varied.descriptors[:n], plain.descriptors[plain.observations])
    for i in range(m):
        own = varied.keypoints_of(i)
        place = dict(zip(varied.landmark_of_keypoint[own], varied.keypoints[own], strict=True))
        angle = dict(zip(varied.landmark_of_keypoint[own], varied.angles[own], strict=True))
        turns = []
        for copy in (m + 2 * i, m + 2 * i + 1):
            rows = varied.keypoints_of(copy)
            labels = varied.landmark_of_keypoint[rows]
            assert len(set(labels)) == len(labels)
            for label, xy, a in zip(
                labels, varied.keypoints[rows], varied.angles[rows], strict=True
            ):
                assert np.hypot(*(xy - place[label])) < 2.01
                turns.append(abs((a - angle[label] + 180) % 360 - 180))
        # Angles are those in the original image, but for the detector's error.
        assert np.median(turns) < 10


def test_threads_change_nothing(folder: Path, plain: Tracks) -> None:
    one, two = (add_augmentations(plain, folder / "images", 1, threads=t) for t in (1, 2))
    np.testing.assert_array_equal(one.descriptors, two.descriptors)
    np.testing.assert_array_equal(one.offsets, two.offsets)


def test_not_for_measuring_and_not_twice(folder: Path, plain: Tracks) -> None:
    varied = add_augmentations(plain, folder / "images", 1)
    with pytest.raises(ValueError, match="for training only"):
        split(varied, 0)
    with pytest.raises(ValueError, match="are augmented already"):
        add_augmentations(varied, folder / "images", 1)
    with pytest.raises(ValueError, match="at least 1"):
        add_augmentations(plain, folder / "images", 0)


def test_command_writes_both_and_keeps_what_is_there(folder: Path, tmp_path: Path) -> None:
    tmp_path /= "of[today]"  # no markup of rich's
    tmp_path.mkdir()
    words = ["tracks", str(folder), "-d", "orb", "--max-keypoints", "300", "-o", str(tmp_path)]
    facts = tmp_path / "facts.json"
    words += ["--json", str(facts), "--threads", "1", "--augmentations", "1"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    path = tmp_path / "plane.orb.augmented.safetensors"
    assert Tracks.load(path).info["augmentations"] == 1
    assert "copies of each keyframe" in done.output
    assert done.output.count("/of[today]/plane.orb.") == 2
    plain, varied = json.loads(facts.read_text())
    assert (plain["file"], varied["file"]) == (str(tmp_path / "plane.orb.safetensors"), str(path))
    assert "augmentations" not in plain
    assert (varied["augmentations"], varied["skipped"]) == (1, False)
    assert varied["observations"] == len(Tracks.load(path).observations) > plain["observations"]
    before = path.stat().st_mtime_ns
    assert CliRunner().invoke(app, words).exit_code == 0
    assert path.stat().st_mtime_ns == before
    assert json.loads(facts.read_text())[1] == {**varied, "skipped": True}
    assert CliRunner().invoke(app, [*words[:-1], "2"]).exit_code == 0
    assert Tracks.load(path).info["augmentations"] == 2
