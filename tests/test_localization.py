"""Poses of rendered images in maps of other images, with good and bad queries."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import protomark as pm
from protomark import sample
from protomark.evaluation.frames import QueryFrame, scene_depth
from protomark.evaluation.protocol import split
from protomark.geometry.pose import pose_error
from protomark.localization import Localization, Localizer, PosePrior
from protomark.maps.build import build_map
from protomark.maps.cameras import KEY, cameras_text
from protomark.tracks.extract import TracksOptions, find_sequence
from protomark.tracks.file import Tracks
from protomark.tracks.make import make_tracks
from tracks_scene import PINHOLE, poses, render, texture, write_model, write_sequence

KEYPOINTS = 600
# Between the poses that the maps are made of.
NEW_POSES = poses(15)[[3, 6, 9]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tracks of a plane, in both descriptors that the tests use."""
    return make_plane(tmp_path_factory.mktemp("localization"), "freak", "orb")


def make_plane(folder: Path, *descriptors: str) -> Path:
    """Tracks of a plane."""
    sequence = write_sequence(folder / "plane", count=8)
    for name in descriptors:
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
    return new_images()


def new_images() -> list[NDArray[np.uint8]]:
    """What a camera sees from `NEW_POSES`."""
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
