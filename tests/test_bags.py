"""ROS bags: their images, cameras and times, and a map of one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader

from bag_writer import START, STEP, TOPIC, info_values, write_bag
from conftest import protomark
from mapping_scene import show, walk
from mutation import SEED, mutated
from protomark.features.bag import bag_camera, bag_frames, image_topic, is_bag
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import read_model
from protomark.geometry.pose import camera_centers, compose, inverse, relative_pose
from protomark.localization.batch import LocalizationRequest, localize_files
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.source import Bag, open_source
from test_mapping import trajectory_rmse
from tracks_scene import PINHOLE

KINDS = (".bag", ".mcap", ".db3")
RNG = np.random.default_rng(0)
IMAGES = [cv2.resize(RNG.integers(0, 256, (12, 16), np.uint8), (64, 48)) for _ in range(5)]
LENS = Camera("OPENCV", 64, 48, (60.0, 61.0, 32.5, 24.5, -0.1, 0.02, 1e-3, -1e-3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "encoding", ["mono8", "rgb8", "bgra8", "mono16", "yuyv", "uyvy", "compressed"]
)
def test_images_are_what_was_written(encoding: str, kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / f"run{kind}", IMAGES, encoding=encoding)
    assert is_bag(path)
    assert image_topic(path) == (TOPIC, 5)
    found = list(open_source(path).images())
    for image, expected in zip(found, IMAGES, strict=True):
        assert image.image is not None
        np.testing.assert_allclose(image.image, expected, atol=1)
    np.testing.assert_allclose([i.time for i in found], START + STEP * np.arange(5), atol=1e-6)
    every = open_source(path, 2)
    assert [i.name for i in every.images()] == [i.name for i in found[::2]]
    assert len(every) == 3
    backward = list(open_source(path).images(backward=True))
    assert [i.name for i in backward] == [i.name for i in found[::-1]]


@pytest.mark.parametrize("name", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(name: str, tmp_path: Path) -> None:
    """The middle of a plain red image is as bright in grey as red is."""
    color = {"r": 200, "g": 60, "b": 20}
    tile = np.array([[color[name[0]], color[name[1]]], [color[name[2]], color[name[3]]]], np.uint8)
    path = write_bag(tmp_path / "run.mcap", [np.tile(tile, (24, 32))], encoding=f"bayer_{name}8")
    (image,) = open_source(path).images()
    assert image.image is not None
    gray = 0.299 * 200 + 0.587 * 60 + 0.114 * 20
    assert np.abs(image.image[4:-4, 4:-4] - gray).max() <= 2


@pytest.mark.parametrize("kind", KINDS)
def test_camera_of_a_bag(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / f"run{kind}", IMAGES, info_values(LENS))
    assert bag_camera(path, TOPIC) == LENS
    bag = open_source(path)
    assert isinstance(bag, Bag)
    assert bag.known_camera() == LENS


@pytest.mark.parametrize(
    ("change", "topic", "expected"),
    [
        ({}, "/camera/image_raw/compressed", LENS),
        ({}, "/camera/image_rect", Camera("PINHOLE", 64, 48, LENS.params[:4])),
        ({"distortion_model": "equidistant"}, TOPIC, replace(LENS, model="OPENCV_FISHEYE")),
        (
            {"distortion_model": "", "d": np.zeros(0)},
            TOPIC,
            Camera("PINHOLE", 64, 48, LENS.params[:4]),
        ),
        ({"k": np.zeros(9)}, TOPIC, None),
        # A sensor of four times as many pixels, read at half the resolution, in part.
        (
            {
                **{"width": 160, "height": 120, "binning_x": 2, "binning_y": 2},
                "part": (16, 12, 96, 128),  # x, y, height, width
                "k": np.array([120, 0, 80.5, 0, 122, 60.5, 0, 0, 1.0]),
            },
            TOPIC,
            replace(LENS, params=(60.0, 61.0, 32.5, 24.5, *LENS.params[4:])),
        ),
    ],
)
def test_what_a_camera_info_says(
    change: dict[str, Any], topic: str, expected: Camera | None, tmp_path: Path
) -> None:
    values = {**info_values(LENS), **change}
    encoding = "compressed" if "compressed" in topic else "mono8"
    path = write_bag(tmp_path / "run.mcap", IMAGES, values, encoding, topic)
    assert bag_camera(path, topic) == expected


def test_a_camera_that_cannot_be_used(tmp_path: Path) -> None:
    values = info_values(LENS, "division")
    path = write_bag(tmp_path / "a.mcap", IMAGES, values)
    with pytest.raises(ValueError, match=r"distortion model 'division': give it with --camera"):
        bag_camera(path, TOPIC)
    values = {**info_values(LENS), "height": 30}
    bag = open_source(write_bag(tmp_path / "b.mcap", IMAGES, values))
    with pytest.raises(
        ValueError, match="images of 64 x 48 pixels, but the bag's camera has 64 x 30"
    ):
        bag.known_camera()


def test_times_ascend(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.mcap", IMAGES, stamps=[5.0, 4.0, 0.0, 6.0, 7.0])
    times = [time for _, time, _ in bag_frames(path, TOPIC)]
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(times[:2], 5.0)
    assert times[2] == pytest.approx(START + 2 * STEP)  # a driver without a clock


def test_topics(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.bag", IMAGES, topic="/left/image")
    assert open_source(path, topic="/left/image").names()[0] == "run-000000"
    with pytest.raises(
        ValueError, match="no images on --topic /right; topics with images are /left"
    ):
        open_source(path, topic="/right")
    images = tmp_path / "images"
    images.mkdir()
    with pytest.raises(ValueError, match="is no ROS bag"):
        open_source(images, topic="/left")
    path = write_bag(tmp_path / "empty.mcap", [], info_values(LENS))
    with pytest.raises(ValueError, match=r"topics with images are none|no image was recorded"):
        open_source(path)
    unread = write_bag(tmp_path / "depth.mcap", IMAGES, encoding="32FC1")
    with pytest.raises(ValueError, match="images of encoding '32FC1' are not read"):
        list(open_source(unread).images())


@pytest.mark.parametrize("kind", KINDS)
def test_broken_bags(kind: str, tmp_path: Path) -> None:
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    path = write_bag(tmp_path / f"run{kind}", IMAGES[:2], info_values(LENS), poses=robot(3)[0])
    whole, refused = path.read_bytes(), []
    for _ in range(100):
        path.write_bytes(mutated(whole, rng))
        try:
            bag = open_source(path)
            bag.known_camera()
            list(bag.images())
            bag.read_poses(Path("/tf"))
        except ValueError as error:
            refused.append(str(error))
    print(f"{len(refused)} of 100 refused")
    assert 5 < len(refused) < 100
    assert [text for text in refused if str(path) not in text and "camera" not in text] == []


# The robot's camera looks forward, from where it is mounted on the base.
MOUNT = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.5]], np.float64)
CORRECTION = np.array([[0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 0.0]])  # of odometry, in the map


def robot(count: int) -> tuple[list[tuple[str, float, str, str, Any]], Any]:
    """What a robot says whose camera walks, and (count, 3, 4) world_from_camera."""
    truth = [inverse(pose) for pose in walk(count)]
    back = inverse(MOUNT)
    said = [("/tf_static", START - 9, "base", "/camera", MOUNT)]
    for i, pose in enumerate(truth):
        at, odometry = START + STEP * i, compose(inverse(CORRECTION), compose(pose, back))
        said += [
            ("/tf", at, "odom", "base", odometry),
            ("/odom", at, "odom", "base", odometry),
            ("/slam", at, "map", "", pose),
        ]
    said += [("/tf", START + d, "map", "odom", CORRECTION) for d in (-1, STEP * count)]
    return said, np.array(truth)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_a_bag(kind: str, tmp_path: Path) -> None:
    said, truth = robot(6)
    stamps = [START + STEP * (i + 0.5) for i in range(5)] + [START + 9]
    path = write_bag(tmp_path / f"run{kind}", IMAGES + IMAGES[:1], stamps=stamps, poses=said)
    bag = open_source(path, topic=TOPIC)
    for topic, world in (("/tf", np.eye(3, 4)), ("/odom", inverse(CORRECTION)), ("/slam", None)):
        poses = bag.read_poses(Path(topic))
        found = [poses.find(name) for name in bag.names()]
        assert found[5] is None, "nobody knows where the robot went"
        for i, pose in enumerate(found[:5]):
            assert pose is not None
            between = truth[i : i + 2] if world is None else [compose(world, p) for p in truth[i:]]
            centers = np.array([p[:, 3] for p in between[:2]])
            # The base moves evenly, so the camera turns about it: less than a millimetre.
            np.testing.assert_allclose(camera_centers(pose), centers.mean(axis=0), atol=1e-3)
            turns = [relative_pose(pose, inverse(p))[0] for p in between[:2]]
            np.testing.assert_allclose(turns[0], turns[1].T, atol=1e-7)
    for topic, message in (
        ("/odometry", "no poses on /odometry; topics with poses are /odom, /slam, /tf, /tf_static"),
        (TOPIC, "no poses on /camera/image_raw"),
    ):
        with pytest.raises(ValueError, match=message):
            bag.read_poses(Path(topic))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("poses", "topic", "message"),
    [
        (
            [("/tf", START, "a", "camera", MOUNT), ("/tf", START, "camera", "a", MOUNT)],
            "",
            "itself",
        ),
        ([("/tf", START, "a", "b", MOUNT)], "", "nothing says where the images' frame 'camera' is"),
        ([("/tf", START, "a", "b", MOUNT), ("/tf", START, "c", "b", MOUNT)], "", "has one parent"),
        ([("/tf", START - 9, "a", "camera", MOUNT)], "", "of 5 images 0 were taken while /tf had"),
        ([("/tf", START, "a", "camera", 0.5 * MOUNT)], "", "of 5 images 1"),
        (
            [("/odom", START, "odom", "wheel", MOUNT), ("/tf", START, "base", "camera", MOUNT)],
            "/odom",
            "/odom has the poses of 'wheel', and no transform",
        ),
    ],
)
def test_poses_that_do_not_lead_to_the_camera(
    poses: list[Any], topic: str, message: str, tmp_path: Path
) -> None:
    bag = open_source(write_bag(tmp_path / "run.mcap", IMAGES, poses=poses))
    with pytest.raises((ValueError, UserWarning), match=message):
        bag.read_poses(Path(topic or "/tf"))


def test_a_bag_is_mapped_with_its_poses_and_localized_into_an_mcap(tmp_path: Path) -> None:
    said, truth = robot(16)
    path = write_bag(
        tmp_path / "run.mcap", [show(p) for p in walk(16)], info_values(PINHOLE), poses=said
    )
    scene, found = tmp_path / "scene", tmp_path / "found.mcap"
    done = protomark(
        *("map", path, "--topic", TOPIC, "--poses", "/tf", "-d", "orb", "-o", scene, "--no-seal"),
        *("--max-keypoints", 600),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    np.testing.assert_allclose(read_model(scene / "sparse").centers, truth[:, :, 3], atol=1e-6)
    done = protomark(
        *("localize", scene, path, "--topic", TOPIC, "--poses", "/tf", "-o", tmp_path / "found"),
        *("--every", 4, "--mcap", found),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "recall at 0.05, 5 degrees" in done.stdout
    rows = np.loadtxt(tmp_path / "found" / "trajectory.txt")
    assert len(rows) == 4
    with AnyReader([found]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {
            "/localized/pose": "geometry_msgs/msg/PoseStamped",
            "/tf": "tf2_msgs/msg/TFMessage",
        }
        read = [
            (c.topic, t / 1e9, reader.deserialize(d, c.msgtype)) for c, t, d in reader.messages()
        ]
    stamped = [(time, message) for topic, time, message in read if topic == "/localized/pose"]
    for (time, message), row in zip(stamped, rows, strict=True):
        at, turn = message.pose.position, message.pose.orientation
        values = [time, at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
        np.testing.assert_allclose(values, row, atol=1e-6)
        assert message.header.frame_id == "map"
    links = [message.transforms[0] for topic, _, message in read if topic == "/tf"]
    assert [link.transform.translation.x for link in links] == pytest.approx(rows[:, 1])
    done = protomark("localize", scene, path, "--mcap", tmp_path / "found.bag")
    assert "name a file that ends in .mcap" in done.stderr
    done = protomark("localize", scene, path, "--mcap", found)
    assert "exists, and may be a recording: name a new file" in done.stderr


def test_a_bag_is_mapped_and_localized_with_its_camera(tmp_path: Path) -> None:
    poses = walk(16)
    path = write_bag(tmp_path / "run.mcap", [show(pose) for pose in poses], info_values(PINHOLE))
    notes: list[str] = []
    options = MappingOptions("orb", max_keypoints=600)
    request = MapRequest(path, tmp_path / "scene", options, topic=TOPIC, seal=False)
    request.output.mkdir()
    figures = make_map(request, note=notes.append)
    assert figures["warnings"] == []
    assert any(note.startswith("camera: that of run") for note in notes)
    model = read_model(tmp_path / "scene" / "sparse")
    assert model.names == [f"{path.stem}-{i:06d}" for i in range(16)]
    assert trajectory_rmse(model.centers, camera_centers(poses)) < 0.02
    times = np.loadtxt(tmp_path / "scene" / "trajectory.txt")[:, 0]
    np.testing.assert_allclose(times, START + STEP * np.arange(16), atol=1e-5)
    later = write_bag(
        tmp_path / "later.bag", [show(pose) for pose in walk(31)[::6]], info_values(PINHOLE)
    )
    request = LocalizationRequest(tmp_path / "scene", [later], topic=TOPIC, threads=1)
    batch = localize_files(request, tmp_path / "found")
    assert [image.time for image in batch.images] == pytest.approx(START + STEP * np.arange(6))
    cameras = {image.found.camera for image in batch.images if image.found}
    assert cameras == {PINHOLE}
    assert sum(map(batch.accepted, batch.images)) >= 3  # the walk goes on beyond the map
    trajectory = np.loadtxt(tmp_path / "found" / "trajectory.txt")
    np.testing.assert_allclose(trajectory[0, 0], START, atol=1e-5)
