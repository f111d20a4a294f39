"""Data sets of OpenSfM: written ones, one of the program itself, and broken ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foreign_scene import (
    assert_same,
    check_broken_files,
    counts,
    foreign,
    orb_tracks,
    reprojection_errors,
)
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks
from protomark.tracks.importers import opensfm
from protomark.tracks.importers.opensfm import read, recognizes

F, SIZE = 900.0, (1280, 964)
CAMERAS = (
    Camera("RADIAL", *SIZE, (F, 640.0, 482.0, -0.05, 0.01)),
    Camera("RADIAL_FISHEYE", *SIZE, (F, 640.0, 482.0, -0.05, 0.01)),
    Camera(
        "FULL_OPENCV", *SIZE, (F, 890.0, 641.0, 480.0, -0.05, 0.01, 1e-3, -1e-3, -0.01, 0, 0, 0)
    ),
    Camera("OPENCV_FISHEYE", *SIZE, (F, 890.0, 641.0, 480.0, -0.05, 0.01, 1e-3, -1e-3)),
    Camera("EQUIRECTANGULAR", 1280, 640, (1280.0, 640.0)),
)


def plain_tracks(camera: Camera = CAMERAS[0]) -> Tracks:
    tracks = orb_tracks(camera)
    return replace(tracks, octaves=np.zeros_like(tracks.octaves))


def camera_values(camera: Camera) -> dict[str, Any]:
    width, height, unit = camera.width, camera.height, max(camera.width, camera.height)
    out: dict[str, Any] = {"width": width, "height": height}
    if camera.model == "EQUIRECTANGULAR":
        return out | {"projection_type": "spherical"}
    kind, names = {
        "RADIAL": ("perspective", "focal x y k1 k2"),
        "RADIAL_FISHEYE": ("fisheye", "focal x y k1 k2"),
        "FULL_OPENCV": ("brown", "focal_x focal_y c_x c_y k1 k2 p1 p2 k3"),
        "OPENCV_FISHEYE": ("fisheye_opencv", "focal_x focal_y c_x c_y k1 k2 k3 k4"),
    }[camera.model]
    values = dict(zip(names.split(), camera.params, strict=False))
    for name in ("focal", "focal_x", "focal_y"):
        values |= {name: values[name] / unit} if name in values else {}
    if "c_x" in values:
        values |= {
            "c_x": (values["c_x"] - width / 2) / unit,
            "c_y": (values["c_y"] - height / 2) / unit,
        }
    return out | values | {"projection_type": kind}


def write_opensfm(folder: Path, tracks: Tracks, descriptors: Any = None, parts: int = 1) -> Path:
    """Write tracks as OpenSfM does, in as many reconstructions."""
    camera = next(iter(tracks.cameras.values()))
    names, unit = tracks.keyframe_names, max(camera.width, camera.height)
    descriptors = tracks.descriptors if descriptors is None else descriptors
    (folder / "features").mkdir(parents=True)
    lines, shots = ["OPENSFM_TRACKS_VERSION_v2"], {}
    for i, name in enumerate(names):
        rows = tracks.keypoints_of(i)
        xy = tracks.keypoints[rows].astype(float)
        xy = (xy - np.array([camera.width, camera.height]) / 2) / unit
        shape = [xy, tracks.sizes[rows] / unit, tracks.angles[rows]]
        np.savez_compressed(
            folder / "features" / f"{name}.features.npz",
            points=np.column_stack(shape).astype(np.float32),
            descriptors=descriptors[rows],
            colors=np.zeros((len(xy), 3), np.uint8),
            OPENSFM_FEATURES_VERSION=1,
        )
        for feature, track in enumerate(tracks.landmark_of_keypoint[rows].tolist()):
            if track >= 0:
                x, y = xy[feature]
                fields = [name, track, feature, x, y, 0.01, 1, 2, 3, -1, -1]
                lines.append("\t".join(map(str, fields)))
        pose = tracks.cam_from_world[i]
        shots[name] = {
            "rotation": cv2.Rodrigues(pose[:, :3])[0].ravel().tolist(),
            "translation": pose[:, 3].tolist(),
            "camera": "v2 camera",
        }
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    points = {
        str(i): {"coordinates": xyz, "color": [0, 0, 0]}
        for i, xyz in zip(
            tracks.landmark_ids.tolist(), tracks.landmark_positions.tolist(), strict=True
        )
    }
    step = len(names) // parts
    cameras = {"v2 camera": camera_values(camera)}
    whole = [
        {"cameras": cameras, "shots": {n: shots[n] for n in names[i : i + step]}, "points": points}
        for i in range(0, len(names), step)
    ]
    (folder / "reconstruction.json").write_text(json.dumps(whole))
    return folder


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_what_was_written_is_read(camera: Camera, tmp_path: Path) -> None:
    tracks = plain_tracks(camera)
    folder = write_opensfm(tmp_path / "map", tracks)
    file = folder / "reconstruction.json"
    assert recognizes(folder, b"")
    assert recognizes(file, file.read_bytes()[:4096])
    for path in (folder, file):
        found = read(path)
        assert_same(found, tracks)
        assert found.keyframe_names == tracks.keyframe_names
        assert np.abs(reprojection_errors(found)).max() < 2e-3
        assert found.info["detector"] == {"name": "ORB"}


def test_reconstructions_that_nothing_connects(tmp_path: Path) -> None:
    tracks = plain_tracks()
    found = read(write_opensfm(tmp_path / "map", tracks, parts=2))
    half = int(found.offsets[2])
    shift = tracks.landmark_ids[-1] + 1
    label = tracks.landmark_of_keypoint.copy()
    label[half:] = np.where(label[half:] < 0, -1, label[half:] + shift)
    np.testing.assert_array_equal(found.landmark_of_keypoint, label)
    assert [m["keyframes"] for m in found.info["source"]["maps"]] == [2, 2]


def test_akaze_has_angles_in_radians(tmp_path: Path) -> None:
    tracks = plain_tracks()
    data = np.random.default_rng(0).integers(0, 256, (len(tracks.keypoints), 61), dtype=np.uint8)
    radians = replace(tracks, angles=np.radians(tracks.angles).astype(np.float32))
    found = read(write_opensfm(tmp_path / "map", radians, data))
    assert_same(found, replace(tracks, descriptors=data))
    assert found.descriptor == "akaze"


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda n: np.zeros((n, 128), np.uint8), r"HAHOG or SIFT \(128 uint8\) descriptors, but"),
        (
            lambda n: np.zeros((n, 64), np.float32),
            r"\(64 float32\).*protomark build images/ sparse/",
        ),
        (lambda n: np.array([[object()] * 32] * n), r"img|features: .*"),
        (lambda n: np.zeros((n // 2, 32), np.uint8), r"features.npz, features"),
    ],
)
def test_other_descriptors(make: Callable[[int], Any], problem: str, tmp_path: Path) -> None:
    tracks = plain_tracks()
    if "features.npz" in problem:
        tracks = replace(tracks, offsets=np.array([0, *[len(tracks.keypoints)] * 4]))
    folder = write_opensfm(tmp_path / "map", tracks, make(len(tracks.keypoints)))
    with pytest.raises(ValueError, match=problem):
        read(folder)


def test_files_that_are_missing(tmp_path: Path) -> None:
    folder = write_opensfm(tmp_path / "map", plain_tracks())
    (folder / "features" / "00001.jpg.features.npz").unlink()
    assert read(folder).info["source"]["dropped"] == {"keyframes without features": 1}
    (folder / "tracks.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"tracks.csv is missing"):
        read(folder)


def test_broken_data_sets(tmp_path: Path) -> None:
    check_broken_files(write_opensfm(tmp_path / "map", plain_tracks()), read, tmp_path)


def test_a_data_set_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = foreign("opensfm")
    assert recognizes(path, b"")
    with pytest.raises(ValueError, match=r"HAHOG or SIFT \(128 uint8\) descriptors"):
        read(path)
    monkeypatch.setattr(opensfm, "binary_descriptor", lambda *_: "hahog")
    found = read(path)
    assert counts(found)[:2] == (19, 1191)
    errors = reprojection_errors(found)
    assert np.abs(np.median(errors, 0)).max() < 0.1
    assert np.median(np.linalg.norm(errors, axis=1)) < 1.5
