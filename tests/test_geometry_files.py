"""Cameras, poses and models that users bring: taken as they are, or refused by name."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from protomark.geometry.camera import Camera
from protomark.geometry.camera_files import CameraSet, read_cameras
from protomark.geometry.colmap import find_model, read_model
from protomark.geometry.pose_files import poses_of_images, read_poses
from tracks_scene import DISTORTED, PINHOLE, poses, write_model


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PINHOLE 540 360 495 495 5000 180", "principal point lies outside"),
        ("PINHOLE 540 360 495 495 0 0", "principal point lies outside"),
        ("PINHOLE 540 360 500000 500000 270 180", "field of view is 0.062 degrees"),
        ("PINHOLE 540 360 10 10 270 180", "field of view is 175.8 degrees, above 170"),
        ("OPENCV_FISHEYE 480 480 99999 99999 240 240 0 0 0 0", "field of view is 0.28 degrees"),
        ("OPENCV 540 360 495 495 270 180 1000 1000 0 0", "no lens distorts"),
        ("SIMPLE_RADIAL 540 360 495 270 180 -5", "no lens distorts"),
        ("EQUIRECTANGULAR 800 400 1600 800", "not the size of the image"),
    ],
)
def test_a_camera_that_no_lens_has(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        Camera.parse(text)
    model, width, height, params = text.split(maxsplit=3)
    with pytest.raises(ValueError, match=message):
        read_cameras(f"{model}:{params}").find("1.png", int(width), int(height))
    camera = Camera(model, int(width), int(height), tuple(map(float, params.split())))
    write_model(tmp_path / "model", camera, ["1.png"], poses(1))
    for read in (read_model, lambda path: read_cameras(str(path / "cameras.txt"))):
        with pytest.raises(ValueError, match=message):
            read(tmp_path / "model")


@pytest.mark.filterwarnings("error")
def test_cameras_that_lenses_have() -> None:
    PINHOLE.check_lens()
    DISTORTED.check_lens()
    fisheye = "OPENCV_FISHEYE 480 480 129.15 129.257 240 240 0.0381 -0.008 0.0083 -0.0027"
    Camera.parse(fisheye)
    Camera.parse("FULL_OPENCV 640 480 517 516 318 255 0.26 -0.95 -0.005 0.003 1.16 0 0 0")
    Camera("EQUIRECTANGULAR", 1000, 500, (1000.0, 500.0)).check_lens()


def test_a_camera_of_another_resolution_is_warned_of() -> None:
    half = CameraSet((Camera.parse("PINHOLE:991,991,539,338"),))
    with pytest.warns(UserWarning, match="calibrated at 1078 x 676 pixels"):
        half.find("1.png", 540, 360)


def test_cameras_txt_as_editors_write_it(tmp_path: Path) -> None:
    file = tmp_path / "cameras.txt"
    line = "1 PINHOLE 540.0 360 495 495 270 180 # left"
    file.write_text("\ufeff" + line + "\n")
    assert read_cameras(str(file)).cameras == (Camera.parse("PINHOLE 540 360 495 495 270 180"),)
    file.write_text(f"{line}\n{line}\n")
    with pytest.raises(ValueError, match="line 2: a second camera 1"):
        read_cameras(str(file))
    file.write_text("1 PINHOLE 540 360 495\n")
    with pytest.raises(ValueError, match=r"line 1: .* PINHOLE has 4 parameters, not 1"):
        read_cameras(str(file))


def test_a_model_with_byte_order_marks(tmp_path: Path) -> None:
    write_model(tmp_path / "model", PINHOLE, ["1.png", "2.png"], poses(2))
    for file in (tmp_path / "model").iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert read_model(tmp_path / "model").names == ["1.png", "2.png"]
    assert len(read_poses(tmp_path / "model" / "images.txt")) == 2


def test_images_txt_without_lines_for_points(tmp_path: Path) -> None:
    write_model(tmp_path / "model", PINHOLE, ["1.png", "2.png"], poses(2))
    file = tmp_path / "model" / "images.txt"
    text = file.read_text()
    file.write_text("\n" + text)  # COLMAP passes over empty lines in front
    assert len(read_poses(file)) == len(read_model(tmp_path / "model").names) == 2
    file.write_text(text.replace("\n\n", "\n"))
    for read, path in ((read_poses, file), (read_model, file.parent)):
        with pytest.raises(ValueError, match=r"line 2: the line for the points .* is missing"):
            read(path)


def test_several_models_are_named(tmp_path: Path) -> None:
    for number in "01":
        write_model(tmp_path / "sparse" / number, PINHOLE, ["1.png"], poses(1))
    with pytest.warns(UserWarning, match=r"sparse/0 is read, other models exist: .*sparse/1"):
        assert find_model(tmp_path) == tmp_path / "sparse" / "0"
    text = read_model(tmp_path / "sparse" / "0")
    from protomark.geometry.colmap import pycolmap

    both = shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "both")
    (both / "points3D.txt").touch()
    pycolmap.Reconstruction(str(both)).write_binary(str(both))
    with pytest.warns(UserWarning, match="the binary model is read"):
        np.testing.assert_allclose(read_model(both).cam_from_world, text.cam_from_world)


def test_base_names_only_where_they_are_unique(tmp_path: Path) -> None:
    write_model(tmp_path / "one", PINHOLE, ["x/a.png", "b.png"], poses(2))
    for names, expected in (
        (["a.png", "y/b.png"], {"a.png": 0, "y/b.png": 1}),
        (["1/b.png", "2/b.png", "x/a.png"], {"x/a.png": 0}),
    ):
        found = poses_of_images(tmp_path / "one", names)
        assert {n: i for n in names for i in (0, 1) if _is(found.find(n), poses(2)[i])} == expected
        cameras = read_cameras(str(tmp_path / "one")).for_images(names)
        assert set(cameras.by_image) == set(expected)


def _is(pose: NDArray[np.float64] | None, expected: NDArray[np.float64]) -> bool:
    return pose is not None and np.allclose(pose, expected)


def test_seconds_are_no_numbers_of_images(tmp_path: Path) -> None:
    def trajectory(times: list[float]) -> Path:
        file = tmp_path / "tum.txt"
        file.write_text("".join(f"{t} 0 0 {t} 0 0 0 1\n" for t in times))
        return file

    seconds = read_poses(trajectory([0.0, 0.1, 0.2, 0.3, 1.0]))
    assert seconds.find("00001.png") is None
    assert seconds.find("0.1.png") is not None
    assert seconds.find("00001.png", time=0.1) is not None  # a frame of a video
    with pytest.raises(ValueError, match="0 of 9 images"):
        poses_of_images(trajectory([0.0, 0.1, 0.2]), [f"{i}.png" for i in range(9)])
    whole = trajectory([1.0, 2.0, 3.0])
    numbers = read_poses(whole)
    assert numbers.find("00001.png") is not None
    names = [f"{i}.png" for i in range(3, 20)]
    with pytest.warns(UserWarning, match="1 of 17 images have one of 3 poses"):
        poses_of_images(whole, names)
