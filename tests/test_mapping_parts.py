import cv2
import numpy as np
import pytest

import protomark as pm
from mapping_memory import check_changes, check_search, observations
from protomark.features import video as video_module
from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import CameraSet, read_cameras
from protomark.geometry.neighbours import near_pairs
from protomark.geometry.pose import quaternion_from_rotation
from protomark.geometry.pose_files import read_poses
from protomark.mapping.history import FrameRecord
from protomark.mapping.mapper import Mapper
from protomark.mapping.memory import Prototypes
from protomark.mapping.options import MappingOptions
from protomark.mapping.source import ImageFolder, Video, open_source
from protomark.mapping.trust import WAITING, no_map
from tracks_scene import PINHOLE


@pytest.fixture(scope="module")
def encoder():
    return pm.Encoder.load("orb")


@pytest.mark.parametrize("radius", [0.5, 3.0, 40.0])
def test_near_pairs_are_all_pairs_within_the_radius(radius):
    rng = np.random.default_rng(0)
    first, second = rng.uniform(-5, 60, (70, 2)), rng.uniform(0, 50, (90, 2))
    i, j = near_pairs(first, second, radius)
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    want = np.argwhere(distance <= radius)
    np.testing.assert_array_equal(np.column_stack([i, j]), want)


def test_near_pairs_of_nothing():
    i, j = near_pairs(np.zeros((0, 2)), np.zeros((3, 2)), 1.0)
    assert len(i) == len(j) == 0


def test_prototypes_find_their_landmarks(encoder):
    check_search(Prototypes(encoder, 16), squared=True)


def test_taking_back_merging_and_discarding_leave_what_adding_the_rest_gives(encoder):
    check_changes(Prototypes(encoder, 16), Prototypes(encoder, 16))


def test_bytes_that_matching_needs(encoder):
    ids, descriptors = observations(landmarks=12, each=5)
    memory = Prototypes(encoder, 16)
    memory.add(ids, memory.encode(descriptors))
    assert memory.bytes == 12 * 17


def test_prototypes_of_other_dimensions(encoder):
    with pytest.raises(ValueError, match=r"--dim 17.*8, 16"):
        Prototypes(encoder, 17)


def given_camera(text, size):
    return read_cameras(text).find("", *size)


def test_camera_as_text(tmp_path):
    camera = given_camera("PINHOLE:300,300,160,120", (320, 240))
    assert camera == PINHOLE
    assert given_camera("pinhole 320 240 300 300 160 120", (320, 240)) == PINHOLE
    with pytest.raises(ValueError, match="has 640 x 480 pixels"):
        given_camera("PINHOLE 320 240 300 300 160 120", (640, 480))
    file = tmp_path / "cameras.txt"
    file.write_text("# a comment\n1 PINHOLE 320 240 300 300 160 120\n")
    assert given_camera(str(file), (320, 240)) == PINHOLE
    assert given_camera(str(tmp_path), (320, 240)) == PINHOLE


@pytest.mark.parametrize(
    ("content", "say"),
    [
        ("1 PINHOLE 640 480 300 300 160 120\n", "has 320 x 240 pixels, and no camera does"),
        ("1 PINHOLE 320 240 300 300 160\n", "line 1: write a COLMAP camera"),
        ("1 PINHOLE 320 240 0 0 160 120\n", "line 1: write a COLMAP camera"),
        ("1 LENS 320 240 300 300 160 120\n", "line 1: write a COLMAP camera"),
        ("1 PINHOLE 320 240 nan 300 160 120\n", "line 1: write a COLMAP camera"),
        ("", "no cameras"),
    ],
)
def test_camera_that_is_none(tmp_path, content, say):
    file = tmp_path / "cameras.txt"
    file.write_text(content)
    with pytest.raises(ValueError, match=say):
        given_camera(str(file), (320, 240))


def test_camera_parameters_that_do_not_fit():
    with pytest.raises(ValueError, match="has 4 parameters, not 2"):
        given_camera("PINHOLE:300,300", (320, 240))
    with pytest.raises(FileNotFoundError, match=r"no cameras\.txt"):
        given_camera("no-such-file", (320, 240))


def test_poses_as_tum_and_as_colmap_agree(tmp_path):
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose = np.column_stack([rotation, [1.0, 2, 3]])
    w, x, y, z = quaternion_from_rotation(rotation)
    colmap = tmp_path / "images.txt"
    colmap.write_text(f"# images\n1 {w} {x} {y} {z} 1 2 3 1 a b.png\n\n")
    np.testing.assert_allclose(read_poses(colmap).find("a b.png", 0.0), pose, atol=1e-12)
    assert read_poses(colmap).find("c.png", 0.0) is None
    place = -rotation.T @ pose[:, 3]
    tum = tmp_path / "trajectory.txt"
    lines = [f"{t} {place[0]} {place[1]} {place[2]} {-x} {-y} {-z} {w}" for t in (1.0, 2.0)]
    tum.write_text("# time and pose\n" + "\n".join(lines) + "\n")
    found = read_poses(tum)
    np.testing.assert_allclose(found.find("any", 1.1), pose, atol=1e-12)
    assert found.find("any", 3.0) is None


@pytest.mark.parametrize(
    ("content", "say"),
    [
        ("1 2 3\n", "write a line"),
        ("1 0 0 0 0 0 0 0\n", "quaternion"),
        ("1 a 0 0 0 0 0 1\n", "not a number"),
        ("1 inf 0 0 0 0 0 1\n", "not finite"),
        ("# nothing\n", "no poses"),
    ],
)
def test_poses_that_are_none(tmp_path, content, say):
    file = tmp_path / "poses.txt"
    file.write_text(content)
    with pytest.raises(ValueError, match=say):
        read_poses(file)


def test_images_come_in_natural_order_and_know_their_times(tmp_path):
    for name in ("img10.png", "img2.png", "notes.txt"):
        if name.endswith("png"):
            cv2.imwrite(str(tmp_path / name), np.zeros((4, 6), np.uint8))
        else:
            (tmp_path / name).write_text("no image")
    folder = open_source(tmp_path)
    assert isinstance(folder, ImageFolder)
    assert folder.names() == ["img2.png", "img10.png"]
    assert folder.size() == (6, 4)
    assert [p.name for p in folder.images(backward=True)] == ["img10.png", "img2.png"]
    assert [p.name for p in folder.images(only={"img10.png"})] == ["img10.png"]
    timed = tmp_path / "timed"
    timed.mkdir()
    for name in ("1305.25.png", "1305.75.png"):
        cv2.imwrite(str(timed / name), np.zeros((4, 6), np.uint8))
    assert [p.time for p in open_source(timed).images()] == [1305.25, 1305.75]


def test_an_image_that_cannot_be_read_is_a_picture_with_a_reason(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 6), np.uint8))
    (tmp_path / "b.png").write_bytes(b"no image")
    pictures = list(open_source(tmp_path).images())
    assert pictures[0].image is not None
    assert pictures[1].image is None
    assert "truncated, or its format is unknown" in pictures[1].problem


def video_of(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for value in frames:
        writer.write(np.full((48, 64, 3), value, np.uint8))
    writer.release()


def test_a_video_frame_by_frame(tmp_path):
    path = tmp_path / "walk.avi"
    video_of(path, range(0, 200, 10))
    video = open_source(path, every=2)
    assert isinstance(video, Video)
    pictures = list(video.images())
    assert len(pictures) == len(video) == 10
    np.testing.assert_allclose([p.time for p in pictures], np.arange(10) * 0.2)
    assert [int(np.median(p.image)) for p in pictures] == pytest.approx(range(0, 200, 20), abs=3)
    backward = list(video.images(backward=True))
    assert [p.name for p in backward] == [p.name for p in pictures][::-1]
    for a, b in zip(backward[::-1], pictures, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
    assert [p.index for p in video.images(7)] == [7, 8, 9]


class Capture:
    """A video of six frames that shows each at its own time, in milliseconds."""

    def __init__(self, times):
        self.times, self.number = times, -1

    def grab(self):
        self.number += 1
        return self.number < len(self.times)

    def get(self, what):
        return self.times[self.number] if what == cv2.CAP_PROP_POS_MSEC else 10.0

    def retrieve(self):
        return True, np.zeros((48, 64), np.uint8)

    def release(self):
        pass


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0, 100, 200, 400, 600, 1000], [0, 0.1, 0.2, 0.4, 0.6, 1.0]),  # a varying rate
        ([0, 0, 0, 0, 0, 0], [0, 0.1, 0.2, 0.3, 0.4, 0.5]),  # a decoder that does not know
        ([0, 100, 90, -1, np.nan, 800], [0, 0.1, 0.2, 0.3, 0.4, 0.8]),
    ],
)
def test_times_of_a_video_are_those_of_its_frames(monkeypatch, tmp_path, times, expected):
    monkeypatch.setattr(video_module, "open_video", lambda path: Capture(times))
    video = Video(tmp_path / "a.mp4")
    np.testing.assert_allclose([time for _, time in video.listing()], expected)
    np.testing.assert_allclose([i.time for i in video.images(backward=True)], expected[::-1])
    other = Video(tmp_path / "a.mp4", every=2)
    np.testing.assert_allclose([i.time for i in other.images()], expected[::2])


def test_a_file_that_is_no_video(tmp_path):
    path = tmp_path / "walk.mp4"
    path.write_bytes(b"\0" * 1000)
    with pytest.raises(ValueError, match="not a video"):
        open_source(path)
    with pytest.raises(FileNotFoundError, match="no such folder of images"):
        open_source(tmp_path / "nothing.mp4")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="no images"):
        open_source(tmp_path / "empty")


def test_a_parallax_that_is_too_small_is_not_rounded_up(tmp_path):
    mapper = Mapper(MappingOptions(), PINHOLE)
    mapper.initialiser.best_parallax = 1.98
    mapper.history.records = {name: FrameRecord(0, name, WAITING) for name in "ab"}
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((240, 320), np.uint8))
    assert "has 1.9 degrees of parallax, 2 are" in no_map(mapper, ImageFolder(tmp_path))


def test_cameras_of_images_are_found_by_base_names_that_are_unique(tmp_path):
    other = Camera("PINHOLE", 320, 240, (400.0, 400.0, 160.0, 120.0))
    for name in ("1.png", "2.png", "3.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((240, 320), np.uint8))
    given = {"left/1.png": PINHOLE, "left/2.png": other, "right/2.png": PINHOLE, "3.png": other}
    folder = ImageFolder(tmp_path)
    folder.find_camera(CameraSet((PINHOLE, other), given))
    assert folder.cameras == {"1.png": PINHOLE, "3.png": other}
    assert [i.camera for i in folder.images()] == [PINHOLE, None, other]
