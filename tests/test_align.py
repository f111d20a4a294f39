"""Scenes that are moved into another world, all stations together, and cropped maps."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import protomark as pm
from conftest import protomark, random_descriptors
from mapping_scene import walk, write_images
from protomark import files
from protomark.cli import terminal
from protomark.cli.align import align
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import find_model, read_model
from protomark.geometry.control_points import ControlPoints, read_control_points, triangulate_marks
from protomark.geometry.pose import camera_centers, transform
from protomark.geometry.pose_files import read_poses, read_positions
from protomark.geometry.similarity import Similarity, fit_robustly
from protomark.interrupt import Interrupted
from protomark.mapping import aligning
from protomark.mapping.aligning import Target, align_scene
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.state import load_state
from protomark.maps.open import open_learning_map
from protomark.maps.split import crop_file
from test_mapping import CAMERA, SETTINGS
from test_mapping_continue import contents
from test_similarity import assert_same, random_similarity

FRAMES = 9


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map")
    images = write_images(folder / "images", walk(FRAMES))
    make_map(MapRequest(images, folder / "scene", SETTINGS, camera=CAMERA))
    (folder / "scene" / "notes.txt").write_text("mine")
    return folder / "scene"


@pytest.fixture
def scene(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "scene"))


def stations(scene: Path) -> dict[str, np.ndarray]:
    """Positions that each station of a scene knows, by name."""
    learning, sealed = pm.open(scene / "scene.pmk"), pm.open(scene / "scene.sealed.pmk")
    model = read_model(find_model(scene))
    return {
        "scene.pmk": learning.positions(learning.ids),
        "scene.sealed.pmk": sealed.positions(sealed.ids),
        "sparse": model.centers,
        "trajectory.txt": camera_centers(read_poses(scene / "trajectory.txt").poses),
    }


def write_positions(path: Path, scene: Path, motion: Similarity, header: str = "") -> Path:
    model = read_model(find_model(scene))
    rng = np.random.default_rng(3)
    to = motion(model.centers) + rng.normal(0, 1e-6, (len(model.names), 3))
    to[2] += 7  # one is wrong
    lines = [f"{n},{x:.9f},{y:.9f},{z:.9f}" for n, (x, y, z) in zip(model.names, to, strict=True)]
    path.write_text(header + "\n".join(lines) + "\n")
    return path


def test_all_stations_move_together(scene: Path, tmp_path: Path) -> None:
    motion = random_similarity(np.random.default_rng(0), scale=3)
    before = stations(scene)
    (tmp_path / "photos").mkdir()
    (scene / "photos").symlink_to(tmp_path / "photos")
    names = set(contents(scene))
    file = write_positions(tmp_path / "gps.csv", scene, motion, "name,x,y,z\n")
    report = tmp_path / "facts.json"
    done = protomark("align", scene, "--to", file, "--frame", "ENU, metres", "--json", report)
    assert done.returncode == 0, done.stderr
    facts = json.loads(report.read_text())
    assert (facts["given"], facts["inliers"]) == (FRAMES, FRAMES - 1)
    assert "img3.png: 12.1" in done.stdout
    for name, positions in stations(scene).items():
        tolerance = 1e-3 if name == "scene.sealed.pmk" else 1e-4  # 16 bits per coordinate
        np.testing.assert_allclose(positions, motion(before[name]), atol=tolerance, err_msg=name)
    assert pm.open(scene).metadata["frame"] == "ENU, metres"
    assert set(contents(scene)) == names
    assert (scene / "photos").is_symlink()
    # The scene is a scene still: it takes more images, and moves back.
    more = write_images(tmp_path / "more", walk(FRAMES + 2)[FRAMES:])
    make_map(MapRequest(more, scene, SETTINGS, camera=CAMERA, extend=True))
    back = write_positions(tmp_path / "back.txt", scene, Similarity(1, np.eye(3), np.zeros(3)))
    align_scene(scene, Target(back))


def test_a_scene_is_scaled_and_turned_up(scene: Path) -> None:
    before = stations(scene)
    facts = align_scene(scene, Target(scale=2, up=True))
    motion = Similarity(2, np.array(facts["rotation"]), np.zeros(3))
    for name, positions in stations(scene).items():
        np.testing.assert_allclose(positions, motion(before[name]), atol=1e-3, err_msg=name)
    model = read_model(find_model(scene))
    up = -model.cam_from_world[:, 1, :3].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=1e-6)
    file = scene / "scene.pmk"
    done = protomark("align", file, "--scale", 0.5)
    assert done.returncode == 0
    assert "scene.sealed.pmk was made of the map as it was before" in done.stderr
    moved = open_learning_map(file)
    np.testing.assert_allclose(moved.positions(moved.ids), motion(before["scene.pmk"]) / 2)


def test_nothing_changes_on_an_error(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(scene)
    two, other, line, broken = (tmp_path / f"{name}.txt" for name in "tolb")
    two.write_text("img1.png 1 2 3\nimg2.png 1 2 4\n")
    rng = np.random.default_rng(1)
    rows = [f"img{i}.png {x} {y} {z}" for i, (x, y, z) in enumerate(rng.normal(size=(9, 3)), 1)]
    other.write_text("\n".join(rows))
    line.write_text("\n".join(f"img{i}.png {i} {2 * i} 0" for i in range(1, 10)))
    broken.write_text("img1.png 1 2 3\nimg2.png 1 nan 3\n")
    for file, message in (
        (two, "2 of 9 images of the scene have a position"),
        (other, "are they those of these images"),
        (line, "lie on a line"),
        (broken, "line 2: a number is not finite"),
        (tmp_path / "none.txt", "no such file"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            align_scene(scene, Target(file))
    for target, message in (
        ({}, "name the world"),
        ({"scale": -1.0}, "is not above 0"),
        ({"positions": two, "up": True}, "leave out the rest"),
    ):
        with pytest.raises(ValueError, match=message):
            Target(**target)
    with pytest.raises(ValueError, match="holds no cameras to align by"):
        align_scene(scene / "scene.pmk", Target(up=True))

    def fail(*_: object) -> None:
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(aligning, "save_state", fail)
        with pytest.raises(OSError, match="full"):
            align_scene(scene, Target(scale=2))
    assert contents(scene) == before
    open_learning_map(scene).seal(scene / "scene.sealed.pmk", bytes_per_landmark=40)
    before = contents(scene)
    with pytest.raises(ValueError, match="was sealed otherwise"):
        align_scene(scene, Target(scale=2))
    assert contents(scene) == before


def test_a_scene_that_may_only_be_read_is_refused(finished: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        scene = Path(shutil.copytree(finished, Path(folder) / "scene"))
        before = contents(scene)
        for closed in (scene, scene.parent):  # it is replaced as a whole
            mode = closed.stat().st_mode
            closed.chmod(0o555)
            try:
                if os.getuid() == 0:  # who may write everywhere
                    os.chown(scene, 65534, -1)
                    os.seteuid(65534)
                with pytest.raises(OSError, match=f"{closed}: no file can be written"):
                    align_scene(scene, Target(scale=2))
            finally:
                os.seteuid(os.getuid())
                closed.chmod(mode)
        assert contents(scene) == before


@pytest.mark.parametrize(
    ("module", "function", "station"),
    [
        (aligning, "save_state", ""),
        (files, "_exchange", ""),
        (terminal, "print_facts", ""),
        (terminal, "print_facts", "scene.pmk"),
    ],
)
def test_ctrl_c_says_whether_the_scene_has_moved(
    module: Any, function: str, station: str, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, before = scene / station, stations(scene)["scene.pmk"]
    original = getattr(module, function)

    def stop(*arguments: Any) -> Any:
        result = original(*arguments)
        if module is files and arguments[1].name != "scene":
            return result  # its model was written
        raise KeyboardInterrupt

    monkeypatch.setattr(module, function, stop)
    moved = module is not aligning
    expected = Interrupted if moved else KeyboardInterrupt
    with pytest.raises(expected, match=f"all of {path} had moved" if moved else "^$"):
        align(path, scale=2.0)
    after = stations(scene)["scene.pmk"]
    np.testing.assert_allclose(after, before * (2 if moved else 1))


def write_marks(path: Path, scene: Path, motion: Similarity, form: str) -> Path:
    """Marks of six landmarks, in two to four images."""
    model, learning = read_model(find_model(scene)), open_learning_map(scene)
    seen = learning.ids[:: len(learning) // 6][:6]
    camera, lines = Camera.parse("PINHOLE 320 240 300 300 160 120"), []
    for number, at in enumerate(learning.positions(seen)):
        x, y, z = motion(at[None])[0] + [7 * (number == 4), 0, 0]  # one is wrong
        for i in (0, 4, 6, 8)[: 2 + number % 3]:
            u, v = camera.project(transform(model.cam_from_world[i], at[None]))[0]
            values = {"image": model.names[i], "u": u, "v": v, "x": x, "y": y, "z": z}
            lines.append(form.format(**values, name=f"p{number}"))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    "form", ["{image},{u},{v},{x},{y},{z},{name}", "{x} {y} {z} {u} {v} {image} {name}"]
)
def test_a_scene_is_moved_to_control_points(scene: Path, form: str, tmp_path: Path) -> None:
    motion = random_similarity(np.random.default_rng(5), scale=3)
    before = stations(scene)
    file = write_marks(tmp_path / "marks.csv", scene, motion, form)
    done = protomark("align", scene, "--to", file)
    assert done.returncode == 0, done.stderr
    assert "control points that fit  5 of 6" in done.stdout
    assert "p4: 7" in done.stdout
    for name in ("scene.pmk", "sparse"):
        np.testing.assert_allclose(stations(scene)[name], motion(before[name]), atol=1e-4)
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:5]))
    done = protomark("align", scene, "--to", file)
    assert "2 of 2 control points are marked in two images" in done.stderr


@pytest.mark.parametrize("model", ["PINHOLE 320 240 150 150", "OPENCV_FISHEYE 320 240 150 150"])
def test_marks_are_triangulated(model: str) -> None:
    camera = Camera.parse(f"{model} 160 120" + " 0" * 4 * ("FISHEYE" in model))
    poses = {f"{i}.jpg": pose for i, pose in enumerate(walk(3, step=0.5))}
    at = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 3], (4, 3))
    marks = [(i, name) for i in range(4) for name in poses if i < 3 or name == "1.jpg"]
    pixels = [camera.project(transform(poses[name], at[i : i + 1]))[0] for i, name in marks]
    names = [*(name for _, name in marks), "other.jpg"]
    given = ControlPoints(
        list("abcd"), at, names, np.array([*pixels, [9, 9]]), np.array([*(i for i, _ in marks), 3])
    )
    found = triangulate_marks(given, lambda name: (camera, poses[name]) if name in poses else None)
    np.testing.assert_allclose(found[:3], at[:3], atol=1e-6)
    assert np.isnan(found[3]).all()


def test_control_points_on_the_globe(tmp_path: Path) -> None:
    file = tmp_path / "gcp_list.txt"
    marks = "8 47 400 10 20 a.jpg p1\n8.001 47 410 11 21 a.jpg\n8 47 400 12 22 b.jpg p1\n"
    for header, distance in (("WGS84", 76.06), ("EPSG:4326", 76.06), ("WGS84 UTM 32N", 0.001)):
        file.write_text(f"{header}\n{marks}")
        found = read_control_points(file)
        assert found is not None
        np.testing.assert_allclose(
            found.positions[1] - found.positions[0], [distance, 0, 10], atol=0.05
        )
        assert found.points.tolist() == [0, 1, 0]
        assert found.names == ["p1", "line 3"]
        assert found.pixels.tolist() == [[10, 20], [11, 21], [12, 22]]
    file.write_text("a.jpg 1 2 3\n")
    assert read_control_points(file) is None
    file.write_text("a.jpg 1 2 3 nan 5\n")
    with pytest.raises(ValueError, match="line 1: a number is not finite"):
        read_control_points(file)


def test_positions_on_the_globe(tmp_path: Path) -> None:
    file = tmp_path / "gps.csv"
    file.write_text(
        "image, lat, lon, alt\na.jpg, 47, 8, 400\nb.jpg, 47.001, 8, 400\nc.jpg, 47, 8.001, 410\n"
    )
    poses = read_positions(file)
    assert poses.frame == (
        "metres east, north and up of latitude 47.000000000, longitude 8.000000000, altitude "
        "400.000 (WGS 84)"
    )
    at = {name: -pose[:, 3] for name, pose in poses.by_name.items()}
    np.testing.assert_allclose(at["a.jpg"], 0, atol=1e-6)
    np.testing.assert_allclose(at["b.jpg"], [0, 111.17, 0], atol=0.05)
    np.testing.assert_allclose(at["c.jpg"], [76.06, 0, 10], atol=0.05)
    file.write_text(file.read_text().partition("\n")[2])
    with pytest.raises(ValueError, match="look like degrees of latitude and longitude: write a"):
        read_positions(file)
    file.write_text("image;x;y;z\na.jpg;1;2;3\n")
    with pytest.raises(ValueError, match="neither lines of image name, x, y, z"):
        read_positions(file)


def test_most_points_decide() -> None:
    rng = np.random.default_rng(2)
    points, true = rng.normal(size=(20, 3)), random_similarity(rng)
    to = true(points)
    to[:8] += rng.normal(0, 3 * true.scale, (8, 3))
    found, inliers = fit_robustly(points, to)
    assert_same(found, true, 1e-6)
    assert inliers.tolist() == [False] * 8 + [True] * 12


def test_a_line_is_no_orientation() -> None:
    line = np.arange(12.0)[:, None] * [1, 2, 3]
    line[3] += [5, -7, 1]  # whatever one wrong point says
    to = 2 * line
    to[3] += [9, 9, -4]
    with pytest.raises(ValueError, match="on a line"):
        fit_robustly(line, to)


def test_maps_are_cropped(encoder: pm.Encoder, tmp_path: Path) -> None:
    scene = pm.PrototypeMap(encoder)
    scene.add(np.arange(10), random_descriptors(10))
    scene.set_positions(np.arange(9), np.arange(9)[:, None] * [1.0, 2, -1])
    scene.metadata = {"frame": "metres"}
    scene.save(tmp_path / "scene.pmk")
    output = tmp_path / "out.pmk"
    for option, text, kept in (
        ("--box", "1.5,0,-9,5,10,0", [2, 3, 4, 5]),
        ("--near", "4,8,-4,2.5", [3, 4, 5]),
    ):
        done = protomark("crop", tmp_path / "scene.pmk", option, text, "-o", output)
        assert done.returncode == 0, done.stderr
        assert "1 landmarks without a position" in done.stdout
        part = open_learning_map(output)
        assert part.ids.tolist() == kept
        np.testing.assert_array_equal(part.prototypes(kept), scene.prototypes(kept))
        assert part.metadata["frame"] == "metres"
    output.unlink()
    for region, message in (
        ({}, "give one of --box, --near and --images"),
        ({"box": (1, 2, 3)}, "--box needs six numbers"),
        ({"box": (1, 1, 1, 0, 2, 2)}, "--box needs six numbers"),
        ({"near": (1, 2, 3, -1)}, "--near needs four numbers"),
        ({"near": (99, 0, 0, 1)}, "no landmark is there; the map has positions from 0,0,-8 to 8,"),
    ):
        with pytest.raises(ValueError, match=message):
            crop_file(tmp_path / "scene.pmk", output, **region)
    with pytest.raises(ValueError, match="does not know which images saw its landmarks"):
        crop_file(tmp_path / "scene.pmk", output, images=["a.jpg"])
    done = protomark("crop", tmp_path / "scene.pmk", "--near", "1,2,x,1", "-o", output)
    assert "is not a list of numbers" in done.stderr
    assert not output.exists()


def test_a_map_is_cropped_to_what_images_see(finished: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.pmk"
    done = protomark(
        "crop", finished, "--images", "img[12].png", "--images", "img9.png", "-o", output
    )
    assert done.returncode == 0, done.stderr
    frames = load_state(finished)[0].structure.frames
    seen = [f.seen for f in frames if f.name in ("img1.png", "img2.png", "img9.png")]
    kept = open_learning_map(output).ids
    assert kept.tolist() == np.unique(np.concatenate(seen)).tolist()
    assert 0 < len(kept) < len(open_learning_map(finished))
    with pytest.raises(ValueError, match="no image of the map has such a name; the first is img1"):
        crop_file(finished, output, images=["img1.jpg"])
