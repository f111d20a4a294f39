"""Large images are reduced before detection, and results come back in their own pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import protomark as pm
from mapping_scene import walk, write_images
from protomark.features.descriptors import DESCRIPTORS
from protomark.features.extractor import FEATURE_ARRAYS, Extractor
from protomark.geometry.camera import Camera
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.maps.build import build_map
from protomark.tracks.extract import TracksOptions, extract, find_sequence
from protomark.tracks.summary import reprojection_errors
from test_wide_cameras import WIDE
from tracks_scene import DISTORTED, PINHOLE, poses, texture, write_model, write_sequence

LARGE = Camera("PINHOLE", 640, 480, (600.0, 600.0, 320.0, 240.0))


def enlarged(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Each pixel becomes two by two, so that reducing the image gives it back exactly."""
    return image.repeat(2, axis=0).repeat(2, axis=1)


def enlarge_folder(source: Path, target: Path) -> Path:
    target.mkdir(parents=True)
    for path in source.iterdir():
        cv2.imwrite(str(target / path.name), enlarged(cv2.imread(str(path), 0)))
    return target


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_a_doubled_image_has_the_same_features_in_its_own_pixels(name: str) -> None:
    image = texture(320)[:240]
    expected = Extractor(name, 300)(image)
    found = Extractor(name, 300, max_size=320)(enlarged(image))
    assert len(expected) > 50
    for array in FEATURE_ARRAYS:
        factor = 2 if array in ("keypoints", "sizes") else 1
        np.testing.assert_array_equal(getattr(found, array), factor * getattr(expected, array))


def test_an_enlarged_image_has_its_keypoints_where_the_original_has_them() -> None:
    image = texture(320)[:240]
    size = (1001, 749)  # not an exact multiple
    large = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    expected = Extractor("akaze", 300)(image).keypoints * (np.array(size) / (320, 240))
    found = Extractor("akaze", 300, max_size=320)(large).keypoints
    nearest = found[((expected[:, None] - found) ** 2).sum(2).argmin(1)]
    off = np.abs(nearest - expected).max(1)
    assert np.median(off) < 0.2 * size[0] / 320
    assert np.abs(np.median(nearest - expected, axis=0)).max() < 0.15


def test_tracks_of_doubled_images_are_those_of_the_originals(tmp_path: Path) -> None:
    small = write_sequence(tmp_path / "small", count=6)
    large = tmp_path / "large"
    enlarge_folder(small / "images", large / "images")
    write_model(large / "sparse", LARGE, [f"img{i + 1}.png" for i in range(6)], poses(6))
    options = TracksOptions("orb", max_keypoints=400)
    expected = extract(find_sequence(small), options)
    found = extract(find_sequence(large), replace(options, max_size=320))
    np.testing.assert_array_equal(found.landmark_of_keypoint, expected.landmark_of_keypoint)
    np.testing.assert_array_equal(found.keypoints, 2 * expected.keypoints)
    np.testing.assert_array_equal(found.landmark_positions, expected.landmark_positions)
    assert found.cameras == {1: LARGE}
    errors = reprojection_errors(found)
    np.testing.assert_allclose(errors, 2 * reprojection_errors(expected), atol=1e-4)
    # Localizing in their map, images of any size have the pose of the small ones.
    localizer = pm.Localizer(build_map(expected, pm.Encoder.load("orb"), 32), max_size=320)
    pose = localizer.localize(small / "images" / "img3.png", PINHOLE)
    same = localizer.localize(large / "images" / "img3.png", LARGE)
    np.testing.assert_allclose(same.cam_from_world, pose.cam_from_world, atol=1e-5)
    np.testing.assert_array_equal(same.pixels, 2 * pose.pixels)


def test_a_map_of_doubled_images_is_that_of_the_originals(tmp_path: Path) -> None:
    small = write_images(tmp_path / "small", walk(8))
    large = enlarge_folder(small, tmp_path / "large")
    options = MappingOptions(descriptor="orb", max_keypoints=400, max_size=320)
    figures = [
        make_map(MapRequest(images, tmp_path / f"map-{images.name}", options, camera=str(camera)))
        for images, camera in ((small, PINHOLE), (large, LARGE))
    ]
    assert figures[1]["camera"] == LARGE.as_dict()
    for key in ("registered", "keyframes", "landmarks", "observations"):
        assert figures[1][key] == pytest.approx(figures[0][key], rel=0.02), key
    errors = [f["reprojection_error_mean"] for f in figures]
    assert errors[1] == pytest.approx(2 * errors[0], rel=0.05)


@pytest.mark.parametrize("size", [0, 63])
def test_a_size_at_which_nothing_is_detected_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"max_size is {size}, but it must be at least 64"):
        Extractor("orb", max_size=size)


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED, *WIDE], ids=lambda camera: camera.model)
def test_a_resized_camera_sees_the_same(camera: Camera) -> None:
    size = np.array([camera.width, camera.height])
    half = camera.resized(camera.width // 2, camera.height // 2)
    pixels = np.random.default_rng(0).uniform(0.2, 0.8, (20, 2)) * size
    np.testing.assert_allclose(half.bearings(pixels / 2), camera.bearings(pixels), atol=1e-6)
    assert camera.resized(*size.tolist()) is camera
