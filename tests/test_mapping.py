"""`protomark map` on rendered images: results, resuming, and bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

import protomark as pm
from mapping_scene import interrupted_at, show, turn_and_approach, walk, write_images
from protomark import report
from protomark.geometry.colmap import pycolmap
from protomark.geometry.pose import camera_centers, quaternion_from_rotation
from protomark.geometry.pose_files import read_poses
from protomark.interrupt import Interrupted
from protomark.mapping import session
from protomark.mapping.frame import InputImage
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Prototypes
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.state import load_state
from protomark.mapping.summary import map_pictures
from protomark.plot import svg_text
from test_tracks_command import fails
from test_tracks_command import run as run_tracks
from tracks_scene import PINHOLE

CAMERA = "PINHOLE:300,300,160,120"
COUNT = 16
SETTINGS = MappingOptions(descriptor="orb", max_keypoints=500, window=5)


def run(*arguments: object):  # type: ignore[no-untyped-def]
    return run_tracks(*arguments, command="map")


def pictures(poses, seed: int = 0) -> list[InputImage]:  # type: ignore[no-untyped-def]
    return [
        InputImage(i, f"{i}.png", float(i), show(pose, seed=seed)) for i, pose in enumerate(poses)
    ]


def error_of(scene: Path, poses) -> float:  # type: ignore[no-untyped-def]
    """Trajectory error in units in which the camera moves 0.08 per frame."""
    found = pycolmap.Reconstruction(str(scene / "sparse"))
    images = sorted(found.images.values(), key=lambda i: int(i.name[3:-4]))
    true = np.array([poses[int(i.name[3:-4]) - 1] for i in images])
    centers = np.array([i.projection_center() for i in images])
    return trajectory_rmse(centers, camera_centers(true))


def trajectory_rmse(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean squared distance of camera centres after the best similarity."""
    aligned = pycolmap.estimate_sim3d(found, true) * found
    return float(np.sqrt(((aligned - true) ** 2).sum(1).mean()))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("walk") / "images", walk(COUNT))


@pytest.fixture(scope="module")
def finished(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = tmp_path_factory.mktemp("map") / "scene"
    figures = make_map(MapRequest(images, scene, SETTINGS, camera=CAMERA))
    assert figures["registered"] == figures["frames"] == COUNT
    return scene


def test_every_frame_is_found_where_it_is(finished: Path) -> None:
    assert error_of(finished, walk(COUNT)) < 0.01


def test_what_is_written_agrees(finished: Path) -> None:
    model = pycolmap.Reconstruction(str(finished / "sparse"))
    scene = pm.open(finished / "scene.pmk")
    assert set(scene.ids.tolist()) == set(model.points3D)
    ids = np.array(sorted(model.points3D))
    xyz = np.array([model.points3D[i].xyz for i in ids.tolist()])
    np.testing.assert_allclose(scene.positions(ids), xyz, rtol=1e-5, atol=1e-5)
    assert model.compute_mean_reprojection_error() < 1
    trajectory = read_poses(finished / "trajectory.txt")
    for image in model.images.values():
        pose = trajectory.find(image.name, float(int(image.name[3:-4]) - 1))
        np.testing.assert_allclose(pose, image.cam_from_world().matrix(), atol=1e-6)
    figures = json.loads((finished / "report.json").read_text())
    assert figures["landmarks"] == len(ids)
    assert figures["observations"] == model.compute_num_observations()
    assert len(figures["history"]) == COUNT


def test_the_report_has_pictures(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "svg_text", svg_text)
    figures = json.loads((finished / "report.json").read_text())
    page = report.map_page(figures, map_pictures(load_state(finished)[0], figures), "Map")
    assert page.count("<svg") == 3
    assert len(page) > 50_000


def test_prototypes_are_what_building_at_once_gives() -> None:
    """After all additions, subtractions and merges, they are sums of the remaining codes."""
    mapper = Mapper(SETTINGS, PINHOLE)
    # A window that never moves on: every observation that is left keeps its code.
    mapper.options = MappingOptions(descriptor="orb", max_keypoints=500, window=100)
    for picture in pictures(walk(9)):
        mapper.add(picture)
    memory, structure = mapper.memory, mapper.structure
    assert isinstance(memory, Prototypes)
    assert len(structure.frames) == 9
    at_once = pm.PrototypeMap(memory.encoder, memory.dim)
    for frame in structure.frames:
        assert frame.encoded is not None
        rows = frame.observed
        at_once.add_codes(frame.landmarks[rows], frame.encoded[rows])
    ids = structure.ids
    np.testing.assert_array_equal(memory.map.ids, ids)
    np.testing.assert_array_equal(at_once.ids, ids)
    np.testing.assert_array_equal(at_once.counts(ids), memory.map.counts(ids))
    np.testing.assert_array_equal(at_once.prototypes(ids), memory.map.prototypes(ids))


def test_time_goes_to_the_stage_that_took_it() -> None:
    mapper = Mapper(SETTINGS, PINHOLE)
    # The camera stands still at first: five frames that wait, with many pairs to try.
    poses = walk(6)
    taken = [mapper.add(p).seconds for p in pictures([*[poses[0]] * 4, *poses])]
    begun = next(i for i, seconds in enumerate(taken) if seconds["triangulate"])
    assert 4 < begun < 10
    for i, seconds in enumerate(taken):
        assert seconds["detect"] > 0
        assert (seconds["initialise"] > 0) == (i <= begun)
        assert (seconds["match"] > 0) == (i >= begun)


def test_only_the_window_keeps_descriptors() -> None:
    mapper = Mapper(SETTINGS, PINHOLE)
    for picture in pictures(walk(12)):
        mapper.add(picture)
    kept = [f for f in mapper.structure.frames if f.descriptors is not None]
    assert len(mapper.structure.keyframes()) > SETTINGS.window
    assert len(kept) == SETTINGS.window
    mapper.finish()
    assert all(f.descriptors is None for f in mapper.structure.frames)
    ids, codes = mapper.structure.codes()
    assert len(ids) == sum(len(f.seen) for f in mapper.structure.frames)
    assert codes.dtype == np.int8
    assert all((f.landmarks >= 0).all() for f in mapper.structure.frames)


@pytest.mark.parametrize("after", [3, 10])
def test_resumed_is_as_if_never_stopped(
    after: int, images: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene"
    request = MapRequest(images, scene, SETTINGS, camera=CAMERA)
    interrupted_at(after, request, monkeypatch, number=signal.SIGINT)
    assert (scene / "scene.pmk").exists()
    with pytest.raises(FileExistsError, match="--resume continues it"):
        make_map(MapRequest(images, scene, SETTINGS, camera=CAMERA))
    make_map(MapRequest(images, scene, SETTINGS, camera=CAMERA, resume=True))
    for name in ("scene.pmk", "trajectory.txt"):
        assert (scene / name).read_bytes() == (finished / name).read_bytes()
    assert not (scene / "checkpoint").exists()


def test_a_finished_map_is_extended_without_old_descriptors(
    images: Path, finished: Path, tmp_path: Path
) -> None:
    scene = Path(shutil.copytree(finished, tmp_path / "scene"))
    before = pm.open(scene / "scene.pmk").ids
    poses = walk(COUNT + 6)
    # Names that the map has already: img1.png and so on.
    more = write_images(tmp_path / "more", poses[COUNT:])
    done = run(more, "--into", scene)
    assert done.returncode == 0, done.stderr
    assert f"{COUNT + 6} of {COUNT + 6} frames registered" in done.stdout
    after = pm.open(scene / "scene.pmk").ids
    assert len(after) > len(before)
    # All but a few that culling and merging took are the landmarks that were there.
    assert np.isin(before, after).mean() > 0.9
    fails(run(more, "--into", scene), "all its 6 frames are in this map already")
    write_images(more, walk(COUNT + 7)[COUNT + 6 :], first=7)
    grown = run(more, "--into", scene)
    assert f"{COUNT + 7} of {COUNT + 7} frames registered" in grown.stdout


def test_given_poses_stay_and_structure_is_built(images: Path, tmp_path: Path) -> None:
    poses = walk(COUNT)
    lines = []
    for i, pose in enumerate(poses, 1):
        numbers = " ".join(
            repr(float(v)) for v in (*quaternion_from_rotation(pose[:, :3]), *pose[:, 3])
        )
        lines.append(f"{i} {numbers} 1 img{i}.png\n\n" if i != 4 else "")
    (tmp_path / "images.txt").write_text("".join(lines))
    scene = tmp_path / "scene"
    request = MapRequest(images, scene, SETTINGS, camera=CAMERA, poses=tmp_path / "images.txt")
    figures = make_map(request)
    assert figures["not_registered"] == {"no pose is given for it": ["img4.png"]}
    model = pycolmap.Reconstruction(str(scene / "sparse"))
    assert model.num_reg_images() == COUNT - 1
    for image in model.images.values():
        want = poses[int(image.name[3:-4]) - 1]
        np.testing.assert_allclose(image.cam_from_world().matrix(), want, atol=1e-9)
    depths = np.array([p.xyz[2] for p in model.points3D.values()])
    walls = np.abs(depths[:, None] - [3.0, 2.2, 1.8]).min(1)
    assert np.median(walls) < 0.03


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("turn") / "images", turn_and_approach(18))


@pytest.fixture(scope="module")
def restarted(turning: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that starts with a wrong focal length, and again with what it finds."""
    scene = tmp_path_factory.mktemp("restarted") / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "elect_focal_length", lambda pairs, size: None)
        make_map(MapRequest(turning, scene, SETTINGS))
    return scene


@pytest.mark.parametrize("elected", [True, False])
def test_an_unknown_camera_is_calibrated_along_the_way(
    elected: bool, turning: Path, restarted: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "scene" if elected else restarted
    if elected:
        make_map(MapRequest(turning, scene, SETTINGS))
    figures = json.loads((scene / "report.json").read_text())
    assert figures["registered"] == 18
    assert figures["camera"]["model"] == "SIMPLE_RADIAL"
    assert figures["camera"]["params"][0] == pytest.approx(300, rel=0.03)
    assert not figures["warnings"]
    # Without an election the map starts with 1.2 times 320, and again with what it finds; the
    # first it finds, early, may be off by so much that it starts once more.
    restarts = [event for event in figures["events"] if "restarts" in event]
    assert len(restarts) in ((0,) if elected else (1, 2))
    assert elected or "not 384 pixels" in restarts[0]
    last = sum(frame["seconds"]["triangulate"] for frame in figures["history"])
    assert (figures["seconds"]["triangulate"] > 1.3 * last) != elected, (
        "the first start counts, too"
    )
    assert error_of(scene, turn_and_approach(18)) < 0.02


@pytest.mark.parametrize("beginning", [1, 2])
def test_resumed_with_an_unknown_camera(
    beginning: int,
    turning: Path,
    restarted: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C comes before or after the map starts again."""
    monkeypatch.setattr(session, "elect_focal_length", lambda pairs, size: None)
    add = Mapper.add
    begun = 0

    def stop_after(self: Mapper, picture: InputImage) -> object:
        nonlocal begun
        begun += picture.index == 0
        if picture.index == 10 and begun == beginning:
            os.kill(os.getpid(), signal.SIGINT)
        return add(self, picture)

    monkeypatch.setattr(Mapper, "add", stop_after)
    with pytest.raises(Interrupted):
        make_map(MapRequest(turning, tmp_path / "scene", SETTINGS))
    monkeypatch.setattr(Mapper, "add", add)
    make_map(MapRequest(turning, tmp_path / "scene", SETTINGS, resume=True))
    for name in ("scene.pmk", "trajectory.txt"):
        assert (tmp_path / "scene" / name).read_bytes() == (restarted / name).read_bytes()


def test_two_threads_make_the_same_map(images: Path, finished: Path, tmp_path: Path) -> None:
    request = MapRequest(images, tmp_path / "scene", SETTINGS, camera=CAMERA, threads=2)
    make_map(request)
    for name in ("scene.pmk", "trajectory.txt"):
        assert (tmp_path / "scene" / name).read_bytes() == (finished / name).read_bytes()


def test_black_blurred_and_broken_frames_are_named_and_cost_nothing_else(
    images: Path, tmp_path: Path
) -> None:
    bad = Path(shutil.copytree(images, tmp_path / "bad"))
    cv2.imwrite(str(bad / "img5.png"), np.zeros((240, 320), np.uint8))
    cv2.imwrite(str(bad / "img8.png"), cv2.GaussianBlur(show(walk(8)[7]), (0, 0), 12))
    (bad / "img11.png").write_bytes(b"no image")
    cv2.imwrite(str(bad / "img13.png"), np.zeros((100, 100), np.uint8))
    figures = make_map(MapRequest(bad, tmp_path / "scene", SETTINGS, camera=CAMERA))
    assert figures["registered"] == COUNT - 4
    reasons = {name: why for why, names in figures["not_registered"].items() for name in names}
    assert set(reasons) == {"img5.png", "img8.png", "img11.png", "img13.png"}
    assert "keypoints" in reasons["img5.png"]
    assert "keypoints" in reasons["img8.png"]
    assert "truncated, or its format is unknown" in reasons["img11.png"]
    assert "100x100 pixels" in reasons["img13.png"]
    assert error_of(tmp_path / "scene", walk(COUNT)) < 0.01


@pytest.mark.parametrize("missing", [(2, 3, 6, 9, 12), (4, 5, 9, 10), (5, 8, 11, 14)])
def test_gaps_do_not_bend_the_map(missing: tuple[int, ...]) -> None:
    poses = walk(COUNT)
    mapper = Mapper(SETTINGS, PINHOLE)
    for picture in pictures(poses):
        if picture.index not in missing:
            mapper.add(picture)
    mapper.finish()
    frames = mapper.structure.frames
    assert len(frames) == COUNT - len(missing)
    found = camera_centers(np.array([frame.pose for frame in frames]))
    true = camera_centers(poses[[frame.index for frame in frames]])
    assert trajectory_rmse(found, true) < 0.01


def test_a_second_scene_stays_out_and_is_named(images: Path, tmp_path: Path) -> None:
    two = Path(shutil.copytree(images, tmp_path / "two"))
    write_images(two, walk(5), seed=100, first=COUNT + 1)
    figures = make_map(MapRequest(two, tmp_path / "scene", SETTINGS, camera=CAMERA))
    assert figures["registered"] == COUNT
    (reason,) = figures["not_registered"]
    assert "not found in the map" in reason
    want = [f"img{COUNT + i}.png" for i in range(1, 6)]
    assert figures["not_registered"][reason] == want


def test_a_turn_on_the_spot_makes_no_map_but_a_sentence(tmp_path: Path) -> None:
    turns = []
    for i in range(8):
        rotation = cv2.Rodrigues(np.array([0.0, 0.03 * i, 0.01 * i]))[0]
        turns.append(np.column_stack([rotation, np.zeros(3)]))
    folder = write_images(tmp_path / "turn", np.array(turns))
    done = run(folder, "-o", tmp_path / "scene", "--camera", CAMERA, "-d", "orb")
    fails(done, "degrees of parallax", "move the camera sideways")


def test_refusals(images: Path, finished: Path, tmp_path: Path) -> None:
    fails(run(images, "-o", finished), "holds a map already", "--into", "--force")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("important")
    fails(run(images, "-o", tmp_path / "mine"), "holds other files")
    fails(run(images), "-o", "--into")
    fails(
        run(tmp_path / "nothing", "-o", tmp_path / "x"),
        "no such folder of images, video file or ROS bag",
    )
    fails(run(images, "--into", tmp_path / "mine"), "name a folder that `protomark map` wrote")
    fails(run(images, "-o", tmp_path / "x", "--resume"), "no interrupted map")
    fails(run(images, "-o", tmp_path / "x", "--dim", "17"), "--dim 17")
    fails(run(images, "-o", tmp_path / "x", "-d", "surf"), "is not a descriptor of OpenCV")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("damage", ["cut", "flip", "other"])
def test_a_broken_state_is_refused(damage: str, finished: Path, tmp_path: Path) -> None:
    scene = Path(shutil.copytree(finished, tmp_path / "scene"))
    data = bytearray((scene / "state.safetensors").read_bytes())
    if damage == "cut":
        del data[len(data) // 2 :]
    elif damage == "flip":
        data[:8] = b"\xff" * 8
    else:
        shutil.copy(scene / "report.html", scene / "state.safetensors")
        data = bytearray((scene / "state.safetensors").read_bytes())
    (scene / "state.safetensors").write_bytes(bytes(data))
    with pytest.raises(pm.FileError, match="broken"):
        load_state(scene)


def test_a_video_is_mapped_as_its_frames_are(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for pose in walk(8):
        writer.write(cv2.cvtColor(show(pose), cv2.COLOR_GRAY2BGR))
    writer.release()
    figures = make_map(MapRequest(path, tmp_path / "scene", SETTINGS, camera=CAMERA))
    assert figures["registered"] == figures["frames"] == 8
    lines = (tmp_path / "scene" / "trajectory.txt").read_text().splitlines()[1:]
    times = [float(line.split()[0]) for line in lines]
    np.testing.assert_allclose(times, np.arange(8) / 10)
