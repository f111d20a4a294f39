"""Maps that are stopped, resumed and extended: what must agree, and what is never lost."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import load, save

import protomark as pm
from mapping_scene import PINHOLE, interrupted_at, walk, write_images
from protomark import interrupt
from protomark.files import SCENE_MAP, SEALED_MAP, STATE
from protomark.geometry.colmap import find_model, read_model
from protomark.geometry.pose import camera_centers
from protomark.geometry.similarity import fit_similarity
from protomark.mapping import session
from protomark.mapping.frame import Frame
from protomark.mapping.prediction import MAX_STEP
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.source import open_source
from protomark.mapping.state import load_state
from protomark.mapping.structure import Structure
from protomark.maps.seal import seal
from test_mapping import CAMERA, SETTINGS, run
from test_tracks_command import fails

FRAMES = 9
# A walk that starts where the map has nothing, and ends in it.
FAR = walk(18, step=0.25)[:2:-1]
FAR_NAMES = [f"img{i}.png" for i in range(1, len(FAR) + 1)]


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("walk") / "images", walk(FRAMES))


@pytest.fixture(scope="module")
def finished(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = tmp_path_factory.mktemp("map") / "scene"
    make_map(MapRequest(images, scene, SETTINGS, camera=CAMERA))
    return scene


@pytest.fixture
def extended(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "scene"))


def contents(folder: Path) -> dict[str, bytes]:
    files = (f for f in folder.rglob("*") if f.is_file())
    return {str(f.relative_to(folder)): f.read_bytes() for f in files}


def test_a_long_step_is_given_up_and_nothing_is_lost(
    images: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The solver ends between two of its calls; the map is as of the last checkpoint."""
    scene, lines = tmp_path / "scene", list[str]()
    monkeypatch.setattr(interrupt, "_PATIENCE", -1.0)
    monkeypatch.setattr(session, "_CHECKPOINT_INTERVAL", 0.0)
    request = MapRequest(images, scene, SETTINGS, camera=CAMERA)
    interrupted_at(6, request, monkeypatch, lines)
    assert "stopping after this frame (again: at once)" in lines
    assert "This map was stopped" in (scene / "report.html").read_text()
    assert '"frames": 6' in (scene / "report.json").read_text()
    make_map(MapRequest(images, scene, SETTINGS, camera=CAMERA, resume=True))
    for name in ("scene.pmk", "trajectory.txt"):
        assert (scene / name).read_bytes() == (finished / name).read_bytes()
    assert "This map was stopped" not in (scene / "report.html").read_text()


def test_resume_takes_the_same_command_only(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene"
    interrupted_at(4, MapRequest(images, scene, SETTINGS, camera=CAMERA), monkeypatch, [])
    other = write_images(tmp_path / "other" / "images", walk(FRAMES), seed=50)
    resume = ("-o", scene, "--resume", "-d", "orb", "--max-keypoints", "500", "--window", "5")
    given = ("--camera", CAMERA)
    fails(run(other, *resume, *given), "the input", str(images.resolve()))
    fails(run(images, *resume, "--camera", "PINHOLE:310,310,160,120"), "--camera", CAMERA)
    fails(run(images, *resume, *given, "--every", "2"), "--every", "1, now: 2")
    fails(run(images, *resume, *given, "--dim", "16"), "--dim", "48, now: 16")
    cv2.imwrite(str(images / "img99.png"), np.zeros((240, 320), np.uint8))
    try:
        fails(run(images, *resume, *given), "the images")
    finally:
        (images / "img99.png").unlink()
    done = run(images, *resume, *given)
    assert f"{FRAMES} of {FRAMES} frames registered" in done.stdout, done.stderr


def test_another_scene_leaves_the_map_as_it_was(extended: Path, tmp_path: Path) -> None:
    before = contents(extended)
    other = write_images(tmp_path / "other", walk(6), seed=50)
    fails(run(other, "--into", extended), "none of its frames fits the map", "not found in the map")
    assert contents(extended) == before
    for path in other.iterdir():
        image = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.resize(image, None, fx=0.75, fy=0.75))
    fails(run(other, "--into", extended), "scene stays as it was")
    assert contents(extended) == before


def test_options_that_differ_from_the_map_are_refused(extended: Path, tmp_path: Path) -> None:
    more = write_images(tmp_path / "more", walk(FRAMES + 4)[FRAMES:])
    into = (more, "--into", extended)
    fails(run(*into, "-d", "akaze"), "--descriptor akaze", "orb")
    fails(run(*into, "--dim", "16"), "--dim 16", "48")
    fails(run(*into, "--focal", "300"), "--focal")
    fails(run(*into, "--camera", "PINHOLE:400,400,160,120"), "was made with PINHOLE 320 240 300")
    done = run(*into, "--camera", "SIMPLE_PINHOLE:300.5,160,120")
    assert done.returncode == 0, done.stderr
    assert (
        "camera: that of scene, PINHOLE 320 240 300 300 160 120, which SIMPLE_PINHOLE"
        in done.stderr
    )
    cameras = pm.open(extended).metadata["cameras"]
    assert len(cameras.splitlines()) == 1
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    fails(run(*into, "--poses", tmp_path / "poses.txt"), "without --poses")


def test_times_stay_unique_and_the_old_map_is_kept(extended: Path, tmp_path: Path) -> None:
    before = contents(extended)
    more = write_images(tmp_path / "more", walk(FRAMES + 4)[FRAMES:])
    done = run(more, "--into", extended, "-d", "orb")
    assert done.returncode == 0, done.stderr
    rows = np.loadtxt(extended / "trajectory.txt")
    assert len(rows) == FRAMES + 4
    assert (np.diff(rows[:, 0]) > 0).all()
    # The time is that of the new frames only.
    report = json.loads((extended / "report.json").read_text())
    assert report["frames_per_second"] == pytest.approx(4 / report["seconds_total"], rel=0.01)
    history = load_state(extended)[0].history
    for record in list(history.records.values())[:FRAMES]:
        record.seconds["match"] = 1e6
    assert sum(history.total_seconds().values()) < 1e6
    assert "those of more are shifted by 9" in done.stderr
    # The camera walks on along x, so the frames are in the order in which they were taken.
    along = rows[:, 1:4] @ np.linalg.svd(rows[:, 1:4] - rows[:, 1:4].mean(0))[2][0]
    assert (np.diff(along) > 0).all() or (np.diff(along) < 0).all()
    assert contents(extended / "previous") == before


def test_images_that_the_map_has_of_another_folder_are_left_out(
    images: Path, extended: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = write_images(tmp_path / "all" / "more", walk(FRAMES + 4)[FRAMES:])
    (more.parent / "again").symlink_to(images)
    fails(run(more.parent / "again", "--into", extended), f"all its {FRAMES} frames are in this")
    request, notes = MapRequest(more.parent, extended, SETTINGS, extend=True), list[str]()
    interrupted_at(FRAMES + MAX_STEP + 2, request, monkeypatch, notes)
    assert f"{FRAMES} images of all are in the map already" in notes
    figures = make_map(replace(request, resume=True))
    assert figures["frames"] == figures["registered"] == FRAMES + 4


@pytest.mark.parametrize(
    ("old", "new", "shift"),
    [
        (["a/0.png", "a/2.png"], ["b/4.png", "b/6.png"], 0),  # later
        (
            ["a/0.png", "a/2.png"],
            ["b/1.png", "b/3.png"],
            2,
        ),  # perhaps of another day
        (["a/0.png", "a/2.png"], ["a/1.png"], 0),  # between those of the same folder
        (["a/0.25.png", "a/2.25.png"], ["b/1.25.png", "b/3.25.png"], 0),  # two cameras at a time
        (["a/0.25.png", "a/2.25.png"], ["b/2.25.png", "b/3.25.png"], 1),  # the same time twice
        (["a/1.png", "a/x.png"], ["b/1.5.png", "b/2.5.png"], 0),  # indices 0 and 1
        (["a/1.png", "a/x.png"], ["b/0.5.png", "b/2.5.png"], 2),
    ],
)
def test_times_are_shifted_only_if_they_would_mix(
    tmp_path: Path, old: list[str], new: list[str], shift: float
) -> None:
    for name in {*old, *new}:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    folders = [Path(names[0]).parent.name for names in (old, new)]
    first, second = (open_source(tmp_path / folder) for folder in folders)
    first.prefix, second.prefix = (f"{folder}/" for folder in folders)
    frames = [
        Frame(i, first.prefix + name, time, 1, *[np.zeros(0)] * 3)
        for i, (name, time) in enumerate(first.listing())
        if first.prefix + name in old
    ]
    structure = Structure({1: PINHOLE})
    structure.frames = frames
    second.follow(structure, [frame.name for frame in frames])
    assert second.time_shift == shift


def test_a_stopped_extension_keeps_the_old_map(
    extended: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(extended)
    more = write_images(tmp_path / "more", walk(FRAMES + 4)[FRAMES:])
    request = MapRequest(more, extended, SETTINGS, extend=True)
    interrupted_at(FRAMES + MAX_STEP + 2, request, monkeypatch)
    assert contents(extended / "previous") == before
    make_map(replace(request, resume=True))
    assert contents(extended / "previous") == before
    assert len(np.loadtxt(extended / "trajectory.txt")) == FRAMES + 4


def test_the_sealed_map_is_tuned_by_what_observed_its_landmarks(
    extended: Path, tmp_path: Path
) -> None:
    scene = pm.open(extended / SCENE_MAP)
    arrays = load((extended / STATE).read_bytes())
    assert len(arrays["landmarks"]) == len(arrays["codes"]) > len(scene)
    expected = tmp_path / "expected.pmk"
    scene.seal(
        expected, arrays["landmarks"], arrays["codes"], bytes_per_landmark=33, position_bits=16
    )
    assert (extended / SEALED_MAP).read_bytes() == expected.read_bytes()
    seal(extended, again := tmp_path / "again.pmk")
    assert again.read_bytes() == expected.read_bytes()
    # Codes of other landmarks tune nothing, and broken ones are named.
    others = {**arrays, "landmarks": np.roll(arrays["landmarks"], 1000)}
    (extended / STATE).write_bytes(save(others))
    seal(extended, again)
    scene.seal(expected, bytes_per_landmark=33, position_bits=16)
    assert again.read_bytes() == expected.read_bytes()
    (extended / STATE).write_bytes(save(arrays)[:-1])
    with pytest.raises(ValueError, match=f"{STATE}: broken .*, or map the images anew"):
        seal(extended, again)


def test_a_session_that_starts_elsewhere_is_mapped_apart_and_merged(
    extended: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, notes = contents(extended), list[str]()
    far_images = write_images(tmp_path / "far", FAR)
    request = MapRequest(far_images, extended, SETTINGS, extend=True)
    interrupted_at(5, request, monkeypatch, notes)
    assert {name: contents(extended)[name] for name in before} == before
    assert not (extended / "previous").exists()
    assert "scene shows none of the first frames: they are mapped apart, to be merged" in notes
    figures = make_map(replace(request, resume=True), note=notes.append)
    assert notes[-1].startswith("far: merged by ")
    assert contents(extended / "previous") == before
    assert figures["registered"] == FRAMES + len(FAR)
    model = read_model(find_model(extended))
    names = [*(f"img{i}.png" for i in range(1, FRAMES + 1)), *(f"far/{n}" for n in FAR_NAMES)]
    centers = model.centers[[model.names.index(name) for name in names]]
    true = camera_centers(np.concatenate([walk(FRAMES), FAR]))
    motion = fit_similarity(centers, true)
    assert np.linalg.norm(motion(centers) - true, axis=1).max() < 0.15
    assert len(model.cameras) == 1
    fails(run(far_images, "--into", extended), "are in this map already")


def test_frames_of_which_no_map_can_be_made_are_added_one_by_one(
    extended: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "_LOOKED_FOR", 1)
    notes = list[str]()
    more = write_images(tmp_path / "more", FAR[[0, -1]])
    figures = make_map(MapRequest(more, extended, SETTINGS, extend=True), note=notes.append)
    assert figures["registered"] == FRAMES + 1
    assert notes[-2].startswith("not merged: ")
    assert notes[-1].startswith("the map has frames of these times")
