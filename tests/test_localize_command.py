"""The command `protomark localize`: what it reads, writes and refuses."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import protomark as pm
from protomark.cli import app
from protomark.geometry.camera_files import camera_from_exif
from protomark.geometry.pose import camera_centers
from protomark.geometry.pose_files import images_txt, read_poses
from protomark.localization import Localizer
from protomark.localization.batch import LocalizationRequest, localize_files
from protomark.maps.build import build_map
from protomark.maps.cameras import KEY, cameras_text
from test_localization import NEW_POSES, make_plane, new_images, tracks_of
from test_tracks_command import fails
from test_tracks_command import run as run_command
from tracks_scene import PINHOLE, quaternion, write_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_plane(tmp_path_factory.mktemp("localize"), "freak")


@pytest.fixture(scope="module")
def scene(folder: Path) -> pm.PrototypeMap:
    return build_map(tracks_of(folder), pm.Encoder.load("freak"), 32)


@pytest.fixture(scope="module")
def images() -> list[NDArray[np.uint8]]:
    return new_images()


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


def test_an_image_that_is_named_twice_is_localized_once(query: Path) -> None:
    folder = query / "images"
    done = run_command(
        *(query / "scene.pmk", folder, folder / "1.png", folder, "-o", query / "o"),
        command="localize",
    )
    assert "warning: 4 images are named twice, such as" in done.stderr
    assert len(list(csv.DictReader((query / "o" / "poses.csv").open()))) == 3


def test_the_exit_code_says_that_no_pose_is_found_and_reasons_are_counted(query: Path) -> None:
    for i in range(3):
        cv2.imwrite(str(query / f"black{i}.png"), np.zeros((240, 320), np.uint8))
    (query / "torn.png").write_bytes((query / "images" / "1.png").read_bytes()[:999])
    images = [query / name for name in ("black0.png", "torn.png", "black1.png", "black2.png")]
    done = run(query / "scene.pmk", *images, "-o", query / "o")
    assert done.exit_code == 1
    assert "3 as black0.png: only 0 keypoints: blurred, dark or empty" in done.output
    assert "1 as torn.png: " in done.output
    assert run(query / "scene.pmk", *images, query / "images", "-o", query / "o").exit_code == 0


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
            *("--camera", "estimate", "--min-confidence", 0),
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
        (["{q}/scene.pmk", "{q}/nowhere"], "no such image, folder, video or bag"),
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
