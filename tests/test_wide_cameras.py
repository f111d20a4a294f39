"""Fisheye and spherical images of a room with six textured walls: mapped, tracked and localized."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import protomark as pm
from mapping_scene import _paper, walk, write_images
from protomark.geometry.absolute_pose import estimate_pose, pose_covariance, refine_pose
from protomark.geometry.camera import Camera
from protomark.geometry.colmap import ColmapModel
from protomark.geometry.given_poses import pose_errors
from protomark.geometry.pose import camera_centers, pose_error, relative_pose, transform, turned
from protomark.geometry.triangulation import depth_of_first, epipolar_error, pixel_errors
from protomark.localization import Localizer
from protomark.mapping.options import MappingOptions
from protomark.mapping.request import MapRequest
from protomark.mapping.session import make_map
from protomark.mapping.source import GIVEN, ImageFolder
from protomark.maps.build import build_map
from protomark.tracks.extract import TracksOptions, extract, find_sequence
from protomark.tracks.pairs import overlaps
from test_mapping import error_of
from test_tracks_command import fails, run
from tracks_scene import write_model

COUNT = 8
HALF = 2.0  # half the side of the room
FISHEYE = Camera("OPENCV_FISHEYE", 480, 480, (129.2, 129.3, 240, 240, 0.038, -0.008, 0.008, -0.003))
WIDE = (
    FISHEYE,
    Camera("FOV", 480, 400, (150.0, 150.0, 240.0, 200.0, 0.9)),
    Camera("SIMPLE_DIVISION", 480, 400, (170.0, 240.0, 200.0, -0.15)),
    Camera("EUCM", 480, 400, (140.0, 140.0, 240.0, 200.0, 0.6, 1.1)),
    Camera("SIMPLE_RADIAL_FISHEYE", 480, 400, (150.0, 240.0, 200.0, 0.01)),
    Camera("EQUIRECTANGULAR", 800, 400, (800.0, 400.0)),
)
POSES = walk(COUNT, step=0.1)
cameras = pytest.mark.parametrize("camera", WIDE, ids=lambda camera: camera.model)


@cache
def picture(camera: Camera, index: int) -> NDArray[np.uint8]:
    """What the camera sees of the walls; black beyond its reach."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    bearings = camera.bearings(np.column_stack([x.ravel(), y.ravel()]))
    shape = (camera.height, camera.width)
    direction, center = bearings @ POSES[index][:, :3], camera_centers(POSES[index])
    with np.errstate(divide="ignore"):
        reach = (np.sign(direction) * HALF - center) / direction
    axis = np.nan_to_num(reach, nan=np.inf).argmin(1)
    hit = center + direction * reach.min(1, keepdims=True)
    out = np.zeros(shape, np.uint8)
    for wall in range(3):
        at = np.delete(hit, wall, 1).astype(np.float32).reshape(*shape, 2) / HALF * 500 + 1000
        for side in (-1, 1):
            on = ((axis == wall) & (side * direction[:, wall] > 0)).reshape(shape)
            paper = _paper(10 * wall + side + 1)
            out[on] = cv2.remap(paper, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[on]
    return out


def write(folder: Path, camera: Camera) -> Path:
    names = [f"img{i + 1}.png" for i in range(COUNT)]
    (folder / "images").mkdir(parents=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / "images" / name), picture(camera, i))
    write_model(folder / "sparse", camera, names, POSES)
    return folder


@cameras
def test_rays_and_projections_are_inverse_where_the_model_reaches(camera: Camera) -> None:
    grid = np.stack(np.meshgrid(np.arange(0.5, camera.width, 9), np.arange(0.5, camera.height, 9)))
    pixels = grid.reshape(2, -1).T
    bearings = camera.bearings(pixels)
    seen = np.isfinite(bearings).all(1)
    assert seen.mean() > 0.6
    np.testing.assert_allclose(camera.project(bearings[seen]), pixels[seen], atol=0.5)
    np.testing.assert_allclose(np.linalg.norm(bearings[seen], axis=1), 1)
    assert (bearings[seen, 2].min() < 0) == (camera.model == "EQUIRECTANGULAR")
    rays, turns = camera.local_rays(pixels)
    assert turns is not None
    np.testing.assert_array_equal(rays, np.where(seen[:, None], [[0.0, 0.0]], np.nan))
    along = np.einsum("nij,nj->ni", turns[seen], bearings[seen])
    np.testing.assert_allclose(along, np.tile([0.0, 0.0, 1.0], (len(along), 1)), atol=1e-12)
    assert camera.resembles(camera)


def test_angles_take_the_place_of_distances_in_the_image_plane() -> None:
    """A point at the side of a spherical camera, seen by two poses: errors are those of its ray."""
    camera = WIDE[-1]
    first, second = np.eye(3, 4), np.column_stack([np.eye(3), [0.0, 0.3, 0.0]])
    points = np.array([[2.0, 0.1, -0.5], [-1.0, 0.2, -2.0], [0.3, 0.1, 3.0]])
    pixels = [camera.project(transform(pose, points)) for pose in (first, second)]
    pixels[1][:, 0] += 2.0
    views = [camera.local_rays(p) for p in pixels]
    poses = [turned(p, turns) for p, (_, turns) in zip((first, second), views, strict=True)]
    focal = camera.focal_length
    assert focal == pytest.approx(800 / (2 * np.pi))
    errors = [
        pixel_errors(points, p, rays, focal) for p, (rays, _) in zip(poses, views, strict=True)
    ]
    np.testing.assert_allclose(errors[0], 0, atol=1e-6)
    latitude = np.pi * (pixels[1][:, 1] / 400 - 0.5)
    np.testing.assert_allclose(errors[1], 2.0 * np.cos(latitude), rtol=1e-3)
    relative = relative_pose(poses[0], poses[1])
    depth, _ = depth_of_first(*relative, views[0][0], views[0][0])
    assert len(depth) == 3
    shifted = epipolar_error(*relative, views[0][0], views[1][0]) * focal
    assert ((shifted > 0.5) & (shifted < 2.1)).all()
    right = pose_errors(poses[0], poses[0] @ np.eye(4), views[0][0], views[0][0], focal)
    np.testing.assert_allclose(right, 0, atol=1e-9)


@cameras
def test_a_pose_is_refined_on_what_lies_in_any_direction(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (200, 3))
    if camera.model != "EQUIRECTANGULAR":
        points[:, 2] = rng.uniform(0.5, 2, 200)
    pixels = camera.project(transform(POSES[3], points)) + rng.normal(0, 0.3, (200, 2))
    inside = np.isfinite(camera.bearings(pixels)).all(1)
    assert inside.sum() > 50
    pixels[~inside] = -5.0
    for focal_length in ("known", "rough", "unknown"):
        given = pixels[inside], points[inside], camera, 3.0
        rough = estimate_pose(*given, focal_length)  # type: ignore[arg-type]
        assert rough is not None
        assert pose_error(rough.cam_from_world, POSES[3])[0] < 0.05
    start = POSES[3].copy()
    start[:, 3] += 0.05
    pose, inliers = refine_pose(start, pixels, points, camera, 3.0)
    assert pose_error(pose, POSES[3])[0] < 0.01
    assert (inliers == inside).mean() > 0.97
    covariance = pose_covariance(pose, pixels[inside], points[inside], camera)
    assert covariance is not None
    # Its deviation is what the noise of the keypoints moves the pose by.
    moved = []
    for _ in range(30):
        noisy = pixels + rng.normal(0, 0.3, pixels.shape)
        again = refine_pose(pose, noisy[inside], points[inside], camera, 3.0)[0]
        moved.append(again[:, 3] - pose[:, 3])
    ratio = np.std(moved, axis=0) / np.sqrt(np.diag(covariance)[3:])
    assert ((ratio > 0.5) & (ratio < 2)).all()


@cameras
def test_wide_images_are_mapped_and_localized(camera: Camera, tmp_path: Path) -> None:
    folder = write(tmp_path / "room", camera)
    options = MappingOptions(descriptor="orb", max_keypoints=1200)
    scene = tmp_path / "map"
    figures = make_map(MapRequest(folder / "images", scene, options, camera=str(camera)))
    assert figures["registered"] == COUNT
    assert figures["warnings"] == []
    assert error_of(scene, POSES) < 0.01
    localizer = Localizer(scene, max_keypoints=1200)
    found = localizer.localize(folder / "images" / "img4.png")
    assert found.camera == camera
    assert found.confidence > 0.9


@cameras
def test_tracks_of_wide_images_lie_on_the_walls(camera: Camera, tmp_path: Path) -> None:
    folder = write(tmp_path / "room", camera)
    tracks = extract(find_sequence(folder), TracksOptions("orb", max_keypoints=1200))
    assert not tracks.info["poses_refined"]
    positions = tracks.landmark_positions
    assert len(positions) > 300
    off = np.abs(np.abs(positions).max(1) - HALF)
    # At twice the baseline away, a pixel is about 0.04 in depth.
    assert np.median(off) < 0.06
    assert np.percentile(off, 85) < 0.3
    behind = positions[:, 2] < -1
    assert (behind.mean() > 0.2) == (camera.model == "EQUIRECTANGULAR")
    localizer = Localizer(build_map(tracks, pm.Encoder.load("orb"), 32), max_keypoints=1200)
    found = localizer.localize(picture(camera, 5), camera)
    assert found.cam_from_world is not None
    distance, degrees = pose_error(found.cam_from_world, POSES[5])
    assert distance < 0.02
    assert degrees < 0.5


def test_a_fisheye_is_not_calibrated_as_a_perspective_camera(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for i in range(2):
        cv2.imwrite(str(images / f"{i}.png"), picture(FISHEYE, i))
    done = run(images, "-o", tmp_path / "map", command="map")
    fails(done, "corners of its images are black", "--camera", "--focal")
    for source in (images, write_images(tmp_path / "perspective", walk(2))):
        camera, origin = ImageFolder(source).guess_camera(300.0)
        assert (camera.focal_length, origin) == (300, GIVEN)
    assert ImageFolder(tmp_path / "perspective").guess_camera()[0].focal_length == 1.2 * 320


def test_spherical_views_overlap_whichever_way_they_turn() -> None:
    back = np.column_stack([np.diag([-1.0, 1.0, -1.0]), [0.1, 0.0, 0.0]])
    for camera, share in ((WIDE[-1], 1.0), (FISHEYE, 0.0)):
        poses, ids = np.stack([np.eye(3, 4), back]), np.ones(2, np.int32)
        model = ColmapModel({1: camera}, ["a", "b"], np.arange(2), ids, poses, [])
        found = overlaps(model, np.full((2, 3), 3.0))
        np.testing.assert_allclose(found, share * (1 - np.eye(2)), atol=0.02)
