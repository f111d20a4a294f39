"""Poses of rendered images in maps of other images, with good and bad queries."""

from __future__ import annotations

import csv
import json
import os
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import protomark as pm
from protomark import sample
from protomark.cli import app
from protomark.evaluation.frames import QueryFrame, scene_depth
from protomark.evaluation.protocol import split
from protomark.geometry.camera_files import camera_from_exif
from protomark.geometry.pose import camera_centers, pose_error
from protomark.geometry.pose_files import images_txt, read_poses
from protomark.localization import Localization, Localizer, PosePrior
from protomark.localization.batch import LocalizationRequest, localize_files
from protomark.maps.build import build_map
from protomark.maps.cameras import KEY, cameras_text
from protomark.tracks.extract import TracksOptions, find_sequence
from protomark.tracks.file import Tracks
from protomark.tracks.make import make_tracks
from test_tracks_command import fails
from test_tracks_command import run as run_command
from tracks_scene import PINHOLE, poses, quaternion, render, texture, write_model, write_sequence

KEYPOINTS = 600
# Between the poses that the maps are made of.
NEW_POSES = poses(15)[[3, 6, 9]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tracks and maps of a plane, in both descriptors that the tests use."""
    folder = tmp_path_factory.mktemp("localization")
    sequence = write_sequence(folder / "plane", count=8)
    for name in ("freak", "orb"):
        options = TracksOptions(descriptor=name, max_keypoints=KEYPOINTS)
        make_tracks(find_sequence(sequence), options, folder)
    return folder


def tracks_of(folder: Path, descriptor: str = "freak") -> Tracks:
    return Tracks.load(folder / f"plane.{descriptor}.safetensors")


@pytest.fixture(scope="module")
def scene(folder: Path) -> pm.PrototypeMap:
    return build_map(tracks_of(folder), pm.Encoder.load("freak"), 32)


@pytest.fixture(scope="module")
def images() -> list[NDArray[np.uint8]]:
    return [render(pose, PINHOLE, texture()) for pose in NEW_POSES]


def close(
    found: Localization, true: NDArray[np.float64], distance: float = 0.02, degrees: float = 0.5
) -> bool:
    assert found.cam_from_world is not None, found.reason
    off, angle = pose_error(found.cam_from_world, true)
    return off < distance and angle < degrees


def test_three_lines(folder: Path, scene: pm.PrototypeMap, images: list[Any]) -> None:
    scene.save(folder / "three.pmk")
    cv2.imwrite(str(folder / "three.png"), images[1])
    localizer = pm.Localizer(pm.open(folder / "three.pmk"), max_keypoints=KEYPOINTS)
    result = localizer.localize(folder / "three.png", PINHOLE)
    assert close(result, NEW_POSES[1])
    assert result.confidence > 0.99
    assert result.inliers == len(result.landmarks) == len(result.pixels) > 30
    assert list(result.seconds) == ["features", "encode", "search", "pose", "total"]
    assert all(s > 0 for s in result.seconds.values())
    # The inliers project to where they were seen.
    seen = scene.positions(result.landmarks) @ result.cam_from_world[:, :3].T
    seen += result.cam_from_world[:, 3]
    pixels = 300 * seen[:, :2] / seen[:, 2:] + (160, 120)
    assert np.abs(pixels - result.pixels).max() < 0.005 * 320


@pytest.mark.parametrize("kind", ["int8", "words", "appearances", "orb", "upright", "64"])
def test_every_kind_of_map(folder: Path, images: list[Any], kind: str, tmp_path: Path) -> None:
    tracks = tracks_of(folder, "orb" if kind == "orb" else "freak")
    encoder = pm.Encoder.load("freak-upright" if kind == "upright" else tracks.descriptor)
    if kind == "upright":
        tracks = tracks.upright()
    appearance_bits = 8 if kind == "appearances" else 0
    dim = 64 if kind == "64" else 32
    made: pm.PrototypeMap | pm.SealedMap = build_map(
        tracks, encoder, dim, appearance_bits=appearance_bits
    )
    if kind in ("int8", "words"):
        assert isinstance(made, pm.PrototypeMap)
        size = dim // 2 + 1 if kind == "words" else None
        made = made.seal(tmp_path / "s.pmk", bytes_per_landmark=size)
    localizer = Localizer(made, max_keypoints=KEYPOINTS)
    for image, pose in zip(images, NEW_POSES, strict=True):
        assert close(localizer.localize(image, PINHOLE), pose)


def test_the_camera_of_the_map(scene: pm.PrototypeMap, images: list[Any], tmp_path: Path) -> None:
    scene = scene.part(scene.ids)  # others share the fixture
    other = replace(PINHOLE, width=300, height=250)
    scene.metadata = {KEY: cameras_text([PINHOLE, other, PINHOLE])}
    sealed = scene.seal(tmp_path / "s.pmk", bytes_per_landmark=33, position_bits=16)
    for made in (scene, sealed):
        localizer = Localizer(made, max_keypoints=KEYPOINTS)
        found = localizer.localize(images[0])
        assert (found.camera, close(found, NEW_POSES[0])) == (PINHOLE, True)
        estimated = localizer.localize(images[0], "estimate")
        assert estimated.camera.model == "SIMPLE_PINHOLE"
        assert localizer.map_camera(240, 320) is None
    several = localizer.localize_many(images, threads=2)
    for found, image in zip(several, images, strict=True):
        np.testing.assert_array_equal(
            found.cam_from_world, localizer.localize(image).cam_from_world
        )
    # Two cameras of one size: nobody knows which.
    scene.metadata = {
        KEY: cameras_text([PINHOLE, replace(PINHOLE, params=(310.0, 310.0, 160.0, 120.0))])
    }
    assert Localizer(scene).map_camera(PINHOLE.width, PINHOLE.height) is None
    scene.metadata = {KEY: "1 PINHOLE 640 480 nonsense"}
    with pytest.raises(ValueError, match="the map's metadata 'cameras' hold no COLMAP camera"):
        Localizer(scene)


def test_unknown_and_rough_focal_lengths(scene: pm.PrototypeMap, images: list[Any]) -> None:
    localizer = Localizer(scene, max_keypoints=KEYPOINTS)
    unknown = localizer.localize(images[0])
    # A plane nearly face on says little of the focal length.
    assert unknown.camera.params[0] == pytest.approx(300, rel=0.1)
    assert close(unknown, NEW_POSES[0], 0.2, 2)
    rough = replace(PINHOLE, params=(330.0, 330.0, 160.0, 120.0))
    refined = localizer.localize(images[0], rough, focal_length="rough")
    assert refined.camera.params[0] == pytest.approx(300, rel=0.1)
    assert close(refined, NEW_POSES[0], 0.2, 2)


def test_images_of_nothing_and_of_another_place(scene: pm.PrototypeMap, images: list[Any]) -> None:
    localizer = Localizer(scene, max_keypoints=KEYPOINTS)
    black = localizer.localize(np.zeros((240, 320), np.uint8), PINHOLE)
    assert (black.cam_from_world, black.confidence) == (None, 0.0)
    assert "0 keypoints" in black.reason
    blurred = localizer.localize(cv2.GaussianBlur(images[0], (0, 0), 12), PINHOLE)
    assert blurred.confidence < 0.5
    for seed in range(4, 12):
        elsewhere = render(NEW_POSES[0], PINHOLE, texture(seed=seed))
        assert localizer.localize(elsewhere, PINHOLE).confidence < 0.5
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    assert localizer.localize(noise, PINHOLE).confidence < 0.5


def test_a_prior_searches_what_it_makes_visible(
    folder: Path, scene: pm.PrototypeMap, images: list[Any]
) -> None:
    localizer = Localizer(scene, max_keypoints=KEYPOINTS)
    prior = PosePrior(NEW_POSES[0], 0.1, 5)
    found = localizer.localize(images[0], PINHOLE, prior)
    assert close(found, NEW_POSES[0])
    # A camera that looks away sees nothing of the map.
    turned = np.diag([-1.0, 1.0, -1.0]) @ NEW_POSES[0]
    nothing = localizer.localize(images[0], PINHOLE, PosePrior(turned, 0.1, 5))
    assert nothing.cam_from_world is None


def test_wrong_use(scene: pm.PrototypeMap, encoder: pm.Encoder, images: list[Any]) -> None:
    bare = pm.PrototypeMap(scene.encoder, 32)
    bare.add([1], np.zeros((1, 64), np.uint8))
    with pytest.raises(ValueError, match="none of the map's 1 landmarks has a position"):
        Localizer(bare)
    localizer = Localizer(scene)
    with pytest.raises(ValueError, match="320 x 240 pixels, but its camera 640 x 480"):
        localizer.localize(images[0], replace(PINHOLE, width=640, height=480))
    with pytest.raises(ValueError, match="PINHOLE has 4 parameters, not 3"):
        localizer.localize(images[0], replace(PINHOLE, params=(300.0, 160.0, 120.0)))
    with pytest.raises(ValueError, match="uint8"):
        localizer.localize(np.zeros((240, 320)), PINHOLE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="3 keypoints, but 2 descriptors"):
        localizer.localize_features(np.zeros((3, 2)), np.zeros((2, 64), np.uint8), PINHOLE)
    other = pm.PrototypeMap(encoder)
    other.add([1], np.zeros((1, 8), np.uint8))
    other.set_positions([1], [[0, 0, 0]])
    with pytest.raises(ValueError, match="protomark calibrate"):
        Localizer(other)


def test_wrong_cameras_are_not_believed(
    folder: Path, scene: pm.PrototypeMap, images: list[Any]
) -> None:
    tracks = Tracks.load(sample.path())
    sampled = Localizer(build_map(tracks, pm.Encoder.load("freak"), 32))
    frames = [QueryFrame.of(tracks, keyframe) for keyframe in (2, 10, 20, 30)]

    def believed(frame: QueryFrame, scale: float, share: float) -> bool:
        params = np.array(frame.camera.params)
        params[frame.camera.colmap.focal_length_idxs()] *= scale
        params[frame.camera.colmap.principal_point_idxs()] += share * frame.camera.width
        camera = replace(frame.camera, params=tuple(params.tolist()))
        found = sampled.localize_features(frame.keypoints, frame.descriptors, camera)
        assert found.confidence >= 0.5 or "do not confirm this camera" in found.reason
        return found.confidence >= 0.9

    assert sum(believed(frame, 1.0, 0.0) for frame in frames) >= 3
    for scale, share in ((0.5, 0), (0.8, 0), (1.25, 0), (2, 0), (1, 0.2), (1, -0.2)):
        assert not any(believed(frame, scale, share) for frame in frames), (scale, share)
    camera, keypoints = frames[0].camera, frames[0].keypoints
    for wrong in (keypoints / (camera.width, camera.height), keypoints[:, ::-1]):
        with pytest.raises(ValueError, match=r"normalised, or \(row, column\)"):
            sampled.localize_features(wrong, frames[0].descriptors, camera)
    for image in images:
        mirrored = Localizer(scene).localize(np.ascontiguousarray(image[:, ::-1]), PINHOLE)
        assert mirrored.confidence < 0.5


def test_what_users_have_in_python(
    scene: pm.PrototypeMap, images: list[Any], tmp_path: Path
) -> None:
    from PIL import Image

    from protomark.geometry.colmap import pycolmap

    localizer = Localizer(scene, max_keypoints=KEYPOINTS)
    expected = localizer.localize(images[0], PINHOLE).cam_from_world
    write_model(tmp_path / "model", PINHOLE, ["a.png"], NEW_POSES[:1])
    Image.fromarray(images[0]).save(tmp_path / "a.png")
    for image in (Image.fromarray(images[0]), images[0][:, :, None], tmp_path / "a.png"):
        for camera in (
            pycolmap.Camera(PINHOLE.as_dict()),
            "PINHOLE:300,300,160,120",
            str(tmp_path / "model"),
        ):
            found = localizer.localize(image, camera)
            np.testing.assert_array_equal(found.cam_from_world, expected)
    with pytest.raises(ValueError, match=r"the image is None, as cv2.imread"):
        localizer.localize(None, PINHOLE)  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match="no such image"):
        localizer.localize("gone.jpg", PINHOLE)
    with pytest.raises(TypeError, match=r"a pycolmap.Camera or a str, not int"):
        localizer.localize(images[0], 7)
    with pytest.raises(TypeError, match="give each process the map's path"):
        pickle.dumps(localizer)
    camera = replace(PINHOLE, params=(300.0, 300.0, 320.0, 240.0))
    with pytest.raises(ValueError, match="principal point lies outside"):
        localizer.localize(images[0], camera)


def test_real_frames_of_the_sample() -> None:
    tracks = Tracks.load(sample.path())
    part = split(tracks, 0)
    kept = np.zeros(len(tracks.keypoints), bool)
    kept[part.support_rows] = True
    localizer = Localizer(build_map(tracks.where(kept), pm.Encoder.load("freak"), 32))
    for keyframe in part.query_keyframes[:4]:
        frame = QueryFrame.of(tracks, int(keyframe))
        found = localizer.localize_features(frame.keypoints, frame.descriptors, frame.camera)
        assert close(found, frame.cam_from_world, 0.01 * scene_depth(tracks))
        assert found.confidence > 0.9


@pytest.fixture
def query(folder: Path, scene: pm.PrototypeMap, images: list[Any], tmp_path: Path) -> Path:
    """A map, three images with true poses, a black image and a file that is no image."""
    scene = scene.part(scene.ids)  # others share the fixture
    # A plane does not tell one focal length from another, so that of the map is needed.
    scene.metadata = {KEY: cameras_text([PINHOLE])}
    scene.save(tmp_path / "scene.pmk")
    (tmp_path / "images").mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "images" / f"{i + 1}.png"), image)
    names = [f"{i + 1}.png" for i in range(len(images))]
    write_model(tmp_path / "true", PINHOLE, names, NEW_POSES)
    return tmp_path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["localize", *map(str, arguments)])


def test_what_is_no_image_of_the_scene_is_named(query: Path) -> None:
    name = os.fsencode(query / "images") + b"/caf\xe9.png"
    shutil.copy(query / "images" / "2.png", name)
    (query / "images" / "masks").mkdir()
    shutil.copy(query / "images" / "2.png", query / "images" / "masks")
    for command, arguments in (
        ("localize", [query / "scene.pmk", query / "images", "-o", query / "o"]),
        ("map", [query / "images", "-o", query / "m", "--camera", PINHOLE, "-d", "orb"]),
    ):
        done = run_command(*arguments, command=command)
        assert "1 whose name is not UTF-8 (caf\\udce9.png)" in done.stderr
        assert "1 folder masks/" in done.stderr
    assert len(list(csv.DictReader((query / "o" / "poses.csv").open()))) == 3
    done = run_command(
        query / "scene.pmk", os.fsdecode(name), "-o", query / "x", command="localize"
    )
    fails(done, "the name of this image is not UTF-8, rename it")


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt])
def test_what_was_localized_is_written_whatever_ends_the_run(
    query: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def until_the_third(self: Localizer, image: NDArray[np.uint8], *rest: Any, **how: Any) -> Any:
        if np.array_equal(image, third):
            raise error
        return localize(self, image, *rest, **how)

    localize, third = Localizer.localize, cv2.imread(str(query / "images" / "3.png"), 0)
    monkeypatch.setattr(Localizer, "localize", until_the_third)
    request = LocalizationRequest(query / "scene.pmk", [query / "images"])
    with pytest.raises(error):
        localize_files(request, query / "out")
    rows = list(csv.DictReader((query / "out" / "poses.csv").open()))
    assert [row["image"] for row in rows] == ["1.png", "2.png"]
    assert all(row["accepted"] == "1" for row in rows)


def test_command(query: Path) -> None:
    cv2.imwrite(str(query / "images" / "black.png"), np.zeros((240, 320), np.uint8))
    (query / "images" / "torn.png").write_bytes((query / "images" / "1.png").read_bytes()[:999])
    cv2.imwrite(str(query / "images" / "small.png"), np.zeros((24, 32), np.uint8))
    out = query / "out"
    done = run(
        *(query / "scene.pmk", query / "images", "-o", out, "--json", query / "f.json"),
        *("--camera", query / "true" / "cameras.txt", "--poses", query / "true" / "images.txt"),
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    facts = json.loads((query / "f.json").read_text())
    assert (facts["images"], facts["localized"], facts["unreadable"]) == (6, 3, 2)
    assert [row["recall"] for row in facts["recall"]] == [1, 1, 1, 1]
    assert re.search(r"recall at 0.05, 5 degrees +1.000 of 3", done.output)

    rows = {row["image"]: row for row in csv.DictReader((out / "poses.csv").open())}
    assert {name for name, row in rows.items() if row["accepted"] == "1"} == {
        f"{i}.png" for i in (1, 2, 3)
    }
    assert "truncated" in rows["torn.png"]["reason"]
    assert "0 keypoints" in rows["black.png"]["reason"]
    assert "32 x 24 pixels" in rows["small.png"]["reason"]
    position = [float(rows["2.png"][f"center_{axis}"]) for axis in "xyz"]
    assert position == pytest.approx(camera_centers(NEW_POSES[1]), abs=0.02)

    from protomark.geometry.colmap import pycolmap

    model = pycolmap.Reconstruction(str(out))
    assert {image.name for image in model.images.values()} == {"1.png", "2.png", "3.png"}
    for image in model.images.values():
        row = rows[image.name]
        assert image.projection_center() == pytest.approx(
            [float(row[f"center_{a}"]) for a in "xyz"], abs=1e-6
        )
        rotation = [float(row[f"cam_from_world_{i}{j}"]) for i in range(3) for j in range(3)]
        turned = image.cam_from_world().rotation.matrix().ravel()
        assert turned == pytest.approx(rotation, abs=1e-6)

    trajectory = read_poses(out / "trajectory.txt")
    assert trajectory.times.tolist() == [0, 1, 2]
    np.testing.assert_allclose(
        trajectory.poses[1],
        model.find_image_with_name("2.png").cam_from_world().matrix(),
        atol=1e-9,
    )

    # What it wrote it may write again, but no model, trajectory or table of others.
    assert run(query / "scene.pmk", query / "images" / "1.png", "-o", out).exit_code == 0
    (query / "map").mkdir()
    (query / "map" / "trajectory.txt").write_text("mine")
    (query / "mine").mkdir()
    (query / "mine" / "poses.csv").write_text("mine")
    for folder in ("true", "map", "mine"):
        before = [path.read_bytes() for path in sorted((query / folder).iterdir())]
        other = run(query / "scene.pmk", query / "images", "-o", query / folder)
        assert "was not written by `protomark localize`" in str(other.exception)
        assert before == [path.read_bytes() for path in sorted((query / folder).iterdir())]


def test_cameras_and_poses_from_elsewhere(query: Path) -> None:
    stamps = []
    for i, pose in enumerate(NEW_POSES):
        w, *v = quaternion(pose[:, :3].T)
        stamps.append(" ".join(map(str, [f"{i + 1}.0", *camera_centers(pose), *v, w])))
    (query / "tum.txt").write_text("# time x y z q\n" + "\n".join(stamps) + "\n")
    for camera in (
        "PINHOLE:300,300,160,120",
        "PINHOLE 320 240 300 300 160 120",
        str(query / "true"),
    ):
        done = run(
            *(query / "scene.pmk", query / "images", "-o", query / "out", "--camera", camera),
            *("--poses", query / "tum.txt", "--priors", query / "true", "--prior-distance", 0.1),
            *("--json", query / "f.json"),
        )
        assert done.exit_code == 0, done.output + str(done.exception)
        facts = json.loads((query / "f.json").read_text())
        assert facts["recall"][0]["recall"] == 1


def test_a_warning_of_a_command_is_one_sentence(query: Path) -> None:
    request = (query / "scene.pmk", query / "images", "-o", query / "out", "--threads", 2)
    done = run_command(*request, "--camera", "PINHOLE:300,300,80,60", command="localize")
    assert done.stderr == (
        "warning: camera PINHOLE 320 240 300 300 80 60: its principal point is far from the middle "
        "of the image: was it calibrated at 160 x 120 pixels?\n"
    )


def test_a_video_is_localized_frame_by_frame(query: Path, images: list[NDArray[np.uint8]]) -> None:
    film = query / "walk.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for image in [image for image in images for _ in range(2)]:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    rows = [
        " ".join(map(str, [f"{0.2 * i:.2f}", *camera_centers(pose), *v, w]))
        for i, pose in enumerate(NEW_POSES)
        for w, *v in [quaternion(pose[:, :3].T)]
    ]
    (query / "tum.txt").write_text("\n".join(rows) + "\n")
    out, camera = query / "out", "PINHOLE:300,300,160,120"
    done = run(
        *(query / "scene.pmk", film, query / "images" / "1.png", "-o", out, "--camera", camera),
        *("--every", 2, "--poses", query / "tum.txt", "--json", query / "f.json"),
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    facts = json.loads((query / "f.json").read_text())
    names = ["walk-000000", "walk-000002", "walk-000004"]
    assert [row["image"] for row in facts["each"]] == [*names, "1.png"]
    assert facts["recall"][0] == {"distance": 0.05, "degrees": 5.0, "recall": 1.0}
    assert facts["with_true_pose"] == 3
    assert facts["localized"] == 4
    done = run(query / "scene.pmk", film, "-o", out, "--camera", camera, "--threads", 2)
    assert read_poses(out / "trajectory.txt").times == pytest.approx(np.arange(6) / 10)
    (query / "notes.txt").write_text("no image")
    (query / "torn.mp4").write_bytes(b"0" * 1000)
    done = run(query / "scene.pmk", query / "notes.txt", film, "-o", out, "--camera", camera)
    assert re.search(r"not usable +1\b", done.output)
    done = run(query / "scene.pmk", query / "torn.mp4", "-o", out)
    assert "not a video that OpenCV can decode" in str(done.exception)


def test_true_poses_of_another_world_are_named(query: Path) -> None:
    request = (query / "scene.pmk", query / "images", "-o", query / "out", "--poses")
    aside = NEW_POSES.copy()
    aside[:, :, 3] -= aside[:, :, :3] @ np.array([10.0, 0, 0])
    for given, told in ((NEW_POSES, False), (aside, True)):
        named = {f"{i}.png": pose for i, pose in enumerate(given, 1)}
        (query / "poses.txt").write_text(images_txt(named, dict.fromkeys(named, 1)))
        done = run(*request, query / "poses.txt")
        assert ("in the map's world" in done.output) == told


def test_geographic_coordinates(query: Path, scene: pm.PrototypeMap) -> None:
    offset = np.array([371234.5, 5412345.25, 520.0])
    moved = scene.part(scene.ids)
    moved.set_positions(moved.ids, scene.positions(scene.ids) + offset)
    moved.save(query / "utm.pmk")
    for name in ("scene", "utm"):
        done = run(
            *(query / f"{name}.pmk", query / "images", "-o", query / name),
            *("--camera", "estimate"),
        )
        assert done.exit_code == 0, done.output + str(done.exception)
    here, there = (
        [
            [float(row[f"center_{axis}"]) for axis in "xyz"]
            for row in csv.DictReader((query / name / "poses.csv").open())
        ]
        for name in ("scene", "utm")
    )
    np.testing.assert_allclose(np.subtract(there, offset), here, atol=1e-4)


def test_without_a_camera(query: Path) -> None:
    done = run(
        *(query / "scene.pmk", query / "images", "--camera", "estimate", "--min-confidence", 0),
        *("-o", query / "o", "--json", query / "f.json"),
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    facts = json.loads((query / "f.json").read_text())
    assert facts["localized"] == 3
    for image in facts["each"]:
        assert image["focal_length"] == pytest.approx(300, rel=0.1)


def test_focal_lengths_of_exif_data_are_refined(query: Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x8769] = {0xA405: 34}  # focal length of 35 mm film, by the image's diagonal 43.3 mm
    with Image.open(query / "images" / "1.png") as image:
        image.save(query / "exif.jpg", quality=98, exif=exif)
    camera = camera_from_exif(query / "exif.jpg")
    assert camera is not None
    assert camera.params[0] == pytest.approx(34 / 43.27 * 400, rel=0.01)
    assert camera_from_exif(query / "images" / "1.png") is None
    done = run(
        query / "scene.pmk", query / "exif.jpg", "-o", query / "o", "--json", query / "f.json"
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    (image,) = json.loads((query / "f.json").read_text())["each"]
    assert image["focal_length"] == pytest.approx(300, rel=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{q}/scene.pmk", "{q}/nowhere"], "no such image, folder or video"),
        (["{q}/scene.pmk", "{q}/true"], "this folder holds no image"),
        (["{q}/scene.pmk", "{q}/images", "--camera", "{q}/gone.txt"], "no cameras.txt"),
        (["{q}/scene.pmk", "{q}/images", "--camera", "PINHOLE 320 240 300"], "has 4 parameters"),
        (["{q}/scene.pmk", "{q}/images", "--camera", "PINHOLE 320 240 a"], "is not a number"),
        (["{q}/scene.pmk", "{q}/images", "--camera", "PINHOLE 32 24 30 30 16 12"], "32 x 24"),
        (
            ["{q}/scene.pmk", "{q}/images", "--poses", "{q}/gone.txt"],
            "folder of poses",
        ),
        (["{q}/scene.pmk", "{q}/images", "--poses", "{q}/true/cameras.txt"], "is not a number"),
        (["{q}/scene.pmk", "{q}/images", "--poses", "{q}/else.txt"], "0 of 3 images have one"),
        (["{q}/scene.pmk", "{q}/images", "--poses", "{q}/long.txt"], "is not 1"),
        (["{q}/images/1.png", "{q}/images"], "1.png"),
    ],
)
def test_bad_input_in_one_sentence(query: Path, arguments: list[str], message: str) -> None:
    (query / "else.txt").write_text("1 1 0 0 0 0 0 0 1 another.png\n\n")
    (query / "long.txt").write_text("1.0 0 0 0 5 0 0 1\n")
    before = shutil.copytree(query / "true", query / "before")
    done = run(*(a.format(q=query) for a in arguments), "-o", query / "out")
    assert isinstance(done.exception, (ValueError, OSError))
    assert message in str(done.exception)
    assert not (query / "out" / "images.txt").exists()
    assert sorted(p.name for p in before.iterdir()) == ["cameras.txt", "images.txt"]
