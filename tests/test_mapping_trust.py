"""Whether maps know what they cannot know: cameras, uncertain poses, and what never moves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapping_scene import interrupted_at, show, structure_of, turn_and_approach, walk, write_images
from protomark.features.static_regions import describe, outside, read_mask, static_regions
from protomark.geometry.absolute_pose import FreeLens
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import read_cameras
from protomark.geometry.colmap import read_model
from protomark.geometry.given_poses import agreeing, misfit, pose_errors
from protomark.geometry.pose import (
    camera_centers,
    quaternion_from_rotation,
    relative_pose,
    transform,
)
from protomark.localization import Localizer
from protomark.mapping import trust
from protomark.mapping.frame import InputImage
from protomark.mapping.initialisation import Initialiser
from protomark.mapping.mapper import Mapper
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.source import open_source
from protomark.mapping.tracking import LandmarkMatches
from protomark.mapping.trust import (
    THROWN,
    UNCERTAIN,
    is_uncertain,
    other_lenses,
    untrusted_frames,
    weak_connections,
    wrong_focal_lengths,
)
from test_mapping import CAMERA, COUNT, error_of, run
from test_tracks_command import fails
from tracks_scene import PINHOLE

SIZE = PINHOLE.width, PINHOLE.height
IMAGE = InputImage(0, "", 0.0, None)


def test_a_frame_that_was_thrown_far_away_is_not_registered() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.6, 0.5, (80, 2)), rng.uniform(2, 3, 80)])
    structure = structure_of(walk(14), points)
    assert not untrusted_frames(structure)
    # As if nothing but distance were wrong: what the frame sees moves along.
    structure.frames[9].pose[:, 3] *= 300
    assert list(untrusted_frames(structure)) == [9]
    structure.frames[9].pose = walk(14)[9]
    for frame in structure.frames[:4]:
        frame.landmarks[:] = structure.create(points * 300)
        frame.pose[:, 3] = 300 * walk(14)[frame.index][:, 3]
    structure.recompute_views()
    assert untrusted_frames(structure) == dict.fromkeys(range(4), THROWN)


def test_parts_that_few_landmarks_connect_are_named() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.6, 0.5, (80, 2)), rng.uniform(2, 3, 80)])
    structure = structure_of(walk(14), points)
    assert not weak_connections(structure, 20)
    for frame in structure.frames:
        frame.landmarks[slice(40, 80) if frame.index < 6 else slice(0, 30)] = -1
    assert not weak_connections(structure, 10), "ten landmarks are left"
    assert weak_connections(structure, 20) == ["6"]
    structure.frames[4].landmarks[30:40] = structure.frames[5].landmarks[30:40] = -1
    assert weak_connections(structure, 10) == []
    structure.frames[0].landmarks[30:40] = structure.frames[1].landmarks[30:40] = -1
    structure.frames[2].landmarks[30:40] = -1
    assert weak_connections(structure, 10) == ["6"], "one keyframe does not know their depth"


def test_a_pose_that_its_landmarks_leave_open_is_uncertain() -> None:
    rng = np.random.default_rng(1)
    far = np.column_stack([rng.uniform(-0.6, 0.5, (60, 2)), rng.uniform(2, 3, 60)])
    close = np.column_stack([rng.uniform(-0.01, 0.01, (60, 2)), rng.uniform(2, 2.01, 60)])
    for points, uncertain in ((far, False), (close, True)):
        structure = structure_of(walk(1), points)
        frame = structure.frames[0]
        matches = LandmarkMatches(frame.observed, frame.seen)
        assert is_uncertain(structure, frame, frame.pose, matches) == uncertain
    assert untrusted_frames(structure) == {0: UNCERTAIN}


def test_a_pose_on_which_few_of_the_expected_matches_agree_is_none() -> None:
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=1000, window=20), PINHOLE)
    for i, pose in enumerate(walk(8)):
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose)))
    frame = mapper.structure.frames[4]
    found = mapper.tracker.relocalize(frame)
    assert found is not None
    expected = mapper.memory.expected(mapper.memory.search(frame.codes)[1])
    assert len(found.matches) > 0.5 * expected > 50
    # As in a place that looks alike: most matches agree on nothing.
    rng = np.random.default_rng(0)
    moved = rng.permutation(len(frame.keypoints))[: int(0.85 * len(frame.keypoints))]
    pixels = frame.keypoints.copy()
    pixels[moved] = rng.uniform((0, 0), SIZE, (len(moved), 2))
    alike = replace(frame, keypoints=pixels, rays=PINHOLE.rays(pixels))
    tracker = mapper.tracker
    tracker.min_inliers = 8
    assert tracker.relocalize(alike) is None
    pixels[moved[len(moved) // 2 :]] = frame.keypoints[moved[len(moved) // 2 :]]
    assert tracker.relocalize(replace(alike, rays=PINHOLE.rays(pixels))) is not None


def logo() -> np.ndarray:
    rng = np.random.default_rng(5)
    return cv2.resize(rng.integers(0, 255, (30, 40), np.uint8), (120, 90), fx=0, fy=0)


def with_logo(folder: Path, poses: np.ndarray) -> Path:
    """Images with a logo in a corner."""
    folder.mkdir()
    for i, pose in enumerate(poses, 1):
        picture = show(pose)
        picture[140:230, 10:130] = logo()
        cv2.imwrite(str(folder / f"img{i}.png"), picture)
    return folder


def test_what_never_moves_is_left_out_and_named(tmp_path: Path) -> None:
    images = with_logo(tmp_path / "images", walk(COUNT))
    done = run(images, "-o", tmp_path / "scene", "--camera", CAMERA, "-d", "orb")
    assert done.returncode == 0, done.stderr
    assert "never moves" in done.stderr
    assert "of the image (x " in done.stdout
    assert f"{COUNT} of {COUNT} frames" in done.stdout
    assert error_of(tmp_path / "scene", walk(COUNT)) < 0.02


def test_static_regions_need_a_scene_that_moves() -> None:
    rng = np.random.default_rng(0)
    still = rng.uniform((0, 0), (80, 60), (60, 2))
    moving = rng.uniform((100, 80), SIZE, (200, 2))
    both = np.concatenate((still, moving))
    moved = np.concatenate((still, np.add(moving, (6.0, 2.0))))
    mask = static_regions([(both, moved)] * 10, SIZE)
    assert outside(mask, moving.astype(np.float32)).all()
    assert outside(mask, still.astype(np.float32)).mean() < 0.3
    assert describe(static_regions([(both, both)] * 10, SIZE)) == ""


def test_a_mask_leaves_its_black_part_out(tmp_path: Path) -> None:
    white = np.full((240, 320), 255, np.uint8)
    white[:, :100] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), white)
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=2000), PINHOLE)
    mapper.mask = read_mask(tmp_path / "mask.png", SIZE)
    for i, pose in enumerate(walk(9)):
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose)))
    assert len(mapper.structure.frames) >= 2
    assert all((frame.keypoints[:, 0] >= 100).all() for frame in mapper.structure.frames)
    with pytest.raises(ValueError, match="320x240 pixels, the images have 640x480"):
        read_mask(tmp_path / "mask.png", (640, 480))
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros_like(white))
    with pytest.raises(ValueError, match="black"):
        read_mask(tmp_path / "mask.png", SIZE)


def images_txt(poses: np.ndarray, file: Path, order: list[int] | None = None) -> Path:
    lines = []
    for i, pose in enumerate(poses, 1):
        numbers = [*quaternion_from_rotation(pose[:, :3]), *pose[:, 3]]
        name = order[i - 1] + 1 if order else i
        lines.append(f"{i} {' '.join(str(float(n)) for n in numbers)} 1 img{name}.png\n\n")
    file.write_text("".join(lines))
    return file


def inverse(pose: np.ndarray) -> np.ndarray:
    return np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])


@pytest.mark.parametrize("wrong", ["camera-to-world", "OpenGL", "shuffled"])
def test_poses_that_do_not_fit_the_images(wrong: str, tmp_path: Path) -> None:
    poses, order = walk(COUNT), None
    if wrong == "camera-to-world":
        poses = np.array([inverse(pose) for pose in poses])
    elif wrong == "OpenGL":
        poses = np.diag([1.0, -1, -1]) @ poses
    else:
        order = np.random.default_rng(0).permutation(COUNT).tolist()
    images = write_images(tmp_path / "images", walk(COUNT))
    given = images_txt(poses, tmp_path / "images.txt", order)
    done = run(images, "-o", tmp_path / "x", "--camera", CAMERA, "--poses", given, "-d", "orb")
    fails(done, "do not fit the images", "camera-to-world")
    assert not (tmp_path / "x").exists()


def test_poses_of_another_world_do_not_extend_a_map(tmp_path: Path) -> None:
    poses = walk(2 * COUNT)
    images = write_images(tmp_path / "images", poses[:COUNT])
    more = write_images(tmp_path / "more", poses[COUNT:])
    given = images_txt(poses[:COUNT], tmp_path / "given.txt")
    scene = tmp_path / "scene"
    made = run(images, "-o", scene, "--camera", CAMERA, "--poses", given, "-d", "orb")
    assert made.returncode == 0, made.stderr
    before = (scene / "scene.pmk").read_bytes()
    # The same walk, ten metres aside: only the map can tell.
    aside = poses[COUNT:].copy()
    aside[:, :, 3] -= aside[:, :, :3] @ np.array([10.0, 0, 0])
    extend = (more, "--into", scene, "--poses")
    fails(run(*extend, images_txt(aside, tmp_path / "aside.txt")), "not in its world", "scale")
    shuffled = images_txt(poses[COUNT:], tmp_path / "shuffled.txt", [*range(COUNT)][::-1])
    fails(run(*extend, shuffled), "do not fit the images", "under its own name")
    assert (scene / "scene.pmk").read_bytes() == before
    done = run(*extend, images_txt(poses[COUNT:], tmp_path / "right.txt"))
    assert f"{2 * COUNT} of {2 * COUNT} frames registered" in done.stdout, done.stderr


def test_poses_that_put_landmarks_behind_the_cameras_do_not_fit() -> None:
    """Epipolar lines alone do not tell a translation from the opposite one."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.6, 0.5, (80, 2)), rng.uniform(2, 3, 80)])
    one, other = walk(6)[[0, 5]]
    first, second = (PINHOLE.rays(PINHOLE.project(transform(p, points))) for p in (one, other))
    assert agreeing(first, second, 300.0).all()
    right = pose_errors(one, other, first, second, 300.0)
    assert right.max() < 1e-6
    opposite = 2 * camera_centers(one) - camera_centers(other)
    other = np.column_stack([other[:, :3], -other[:, :3] @ opposite])
    wrong = pose_errors(one, other, first, second, 300.0)
    assert not misfit([right, right, right, wrong])
    assert "2 of 3 pairs" in misfit([right, wrong, wrong])


def tum(times: list[str], file: Path) -> Path:
    file.write_text("".join(f"{t} {0.1 * i} 0 0 0 0 0 1\n" for i, t in enumerate(times)))
    return file


def test_seconds_are_no_image_numbers(tmp_path: Path) -> None:
    images = write_images(tmp_path / "images", walk(12))
    request = (images, "-o", tmp_path / "x", "--camera", CAMERA, "-d", "orb", "--poses")
    fails(
        run(*request, tum([f"{0.1 * i:.1f}" for i in range(40)], tmp_path / "s")),
        "0 of 12 images",
        "seconds",
    )
    epoch = tum([str(1305031102 + i) for i in range(12)], tmp_path / "epoch")
    fails(run(*request, epoch), "0 of 12 images", "time 1305031102")


def test_the_size_of_most_images_counts(tmp_path: Path) -> None:
    images = write_images(tmp_path / "images", walk(COUNT))
    cv2.imwrite(str(images / "AlbumArt.png"), np.zeros((120, 160), np.uint8))
    done = run(images, "-o", tmp_path / "scene", "--camera", CAMERA, "-d", "orb")
    assert done.returncode == 0, done.stderr
    assert "AlbumArt.png: 160x120 pixels, but the camera has 320x240" in done.stdout


def test_each_image_has_its_own_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, images, model = walk(COUNT), tmp_path / "images", tmp_path / "model"
    cameras = [PINHOLE, Camera("SIMPLE_RADIAL", 400, 300, (330.0, 200.0, 150.0, 0.05))]
    images.mkdir()
    for i, pose in enumerate(poses):
        cv2.imwrite(str(images / f"img{i + 1}.png"), show(pose, cameras[i % 2]))
    model.mkdir()
    images_txt(poses, model / "images.txt")
    text = (model / "images.txt").read_text()
    for i in range(2, COUNT + 1, 2):
        text = text.replace(f" 1 img{i}.png", f" 2 img{i}.png")
    (model / "images.txt").write_text(text)
    lines = [f"{i} {camera}" for i, camera in enumerate(cameras, 1)]
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    options = MappingOptions(descriptor="orb", max_keypoints=600)
    for given in (None, model):  # found poses, and given ones
        scene = tmp_path / f"scene-{given is None}"
        figures = make_map(MapRequest(images, scene, options, camera=str(model), poses=given))
        assert figures["registered"] == COUNT
        assert error_of(scene, poses) < 0.01
        made = read_model(scene / "sparse")
        used = {n: made.cameras[int(i)] for n, i in zip(made.names, made.camera_ids, strict=True)}
        assert used == {f"img{i + 1}.png": cameras[i % 2] for i in range(COUNT)}
        assert set(Localizer(scene).cameras.cameras) == set(cameras)
    request = MapRequest(images, tmp_path / "resumed", options, camera=str(model))
    interrupted_at(6, request, monkeypatch)
    resumed = make_map(replace(request, resume=True))
    assert (
        resumed["landmarks"]
        == json.loads((tmp_path / "scene-True" / "report.json").read_text())["landmarks"]
    )
    # COLMAP gives each image its own camera, and these hardly differ.
    lines = [f"{i} PINHOLE 320 240 {300 + i / 10} 300 160 120" for i in range(1, 3)]
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    source = open_source(images)
    found = source.find_camera(read_cameras(str(model)))
    assert set(source.cameras.values()) == {found}


def test_one_image_makes_no_map(tmp_path: Path) -> None:
    one = write_images(tmp_path / "one", walk(1))
    fails(run(one, "-o", tmp_path / "x", "--camera", CAMERA, "-d", "orb"), "give several")


def test_black_images_are_named_as_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((240, 320), np.uint8))
    done = run(folder, "-o", tmp_path / "x", "--camera", CAMERA, "-d", "orb")
    fails(done, "4 have this in common", "black, blurred")
    assert not (tmp_path / "x").exists()


def test_rivals_for_the_first_pair_are_adjusted_before_they_are_compared() -> None:
    """A relative pose by little parallax is rough, and its landmarks fit other frames badly."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (250, 2)), rng.uniform(2, 2.4, 250)])
    structure, poses = structure_of(walk(6, step=0.03), points), walk(6, step=0.03)
    initialiser = Initialiser(structure)
    initialiser.waiting = structure.frames
    one, other = structure.frames[0], structure.frames[5]
    rows = np.repeat(np.arange(250)[:, None], 2, axis=1)
    true = np.column_stack(relative_pose(poses[0], poses[5]))
    true[:, 3] /= np.linalg.norm(true[:, 3])
    rough = cv2.Rodrigues(np.radians([0.0, 8.0, 8.0]))[0] @ true[:, 3]
    turn = cv2.Rodrigues(np.radians([0.0, -0.1, 0.1]))[0]
    witnesses = [(frame, rows) for frame in structure.frames[1:5]]
    found = [
        initialiser._support(one, other, rows, pose, witnesses)
        for pose in (np.column_stack([turn @ true[:, :3], rough]), true)
    ]
    for support in found:
        assert support.pose[:, 3] @ true[:, 3] > np.cos(np.radians(10))
        assert support.share > 0.9
    assert found[0].score > 0.6 * found[1].score


def test_a_given_camera_that_the_images_contradict() -> None:
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=500), PINHOLE)
    for i, pose in enumerate(turn_and_approach(14)):
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose)))
    mapper.finish()
    assert wrong_focal_lengths(mapper.structure) == []
    wrong = replace(PINHOLE, params=(360.0, 360.0, *PINHOLE.params[2:]))
    for i in mapper.structure.cameras:
        mapper.structure.set_camera(i, wrong)
    (sentence,) = wrong_focal_lengths(mapper.structure)
    assert "the camera has a focal length of 360 pixels" in sentence


def test_a_zoomed_frame_is_named() -> None:
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=500), PINHOLE)
    zoomed = replace(PINHOLE, params=(360.0, 360.0, *PINHOLE.params[2:]))
    for i, pose in enumerate(turn_and_approach(16)):
        camera = zoomed if i == 14 else PINHOLE
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose, camera)))
    mapper.finish()
    assert other_lenses(mapper.structure) == ["14.png"]


def test_frames_that_leave_the_focal_length_open_are_of_no_other_lens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From above, a flat scene moves the focal length by more than its landmarks' noise says."""
    mapper = Mapper(MappingOptions(descriptor="orb", max_keypoints=500), PINHOLE)
    for i, pose in enumerate(turn_and_approach(16)):
        mapper.add(InputImage(i, f"{i}.png", float(i), show(pose)))
    mapper.finish()
    stretches = iter(np.exp([*np.linspace(-0.05, 0.05, 15), 0.3]))
    monkeypatch.setattr(
        trust, "free_lens", lambda pose, *_: FreeLens(pose, 0.0, 0.01, next(stretches), 0.01)
    )
    names = [frame.name for frame in mapper.structure.frames]
    assert other_lenses(mapper.structure) == names[-1:]
