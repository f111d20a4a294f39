"""Maps of Astrobee, written as its sources say, and broken ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from astrobee_writer import write_astrobee
from foreign_scene import PINHOLE, assert_same, check_broken_files, orb_tracks, reprojection_errors
from protomark.geometry.camera import Camera
from protomark.maps.build import build_map
from protomark.tracks.file import Tracks
from protomark.tracks.importers.astrobee import read, recognizes

LENS = (620.0, 618.0, 640.5, 482.5)
CAMERAS = (
    PINHOLE,
    Camera("FOV", 1280, 964, (*LENS, 0.7)),
    Camera("OPENCV_FISHEYE", 1280, 964, (*LENS, 0.01, -0.002, 0.0, 0.0)),
    Camera("OPENCV", 1280, 964, (*LENS, -0.1, 0.01, 1e-3, -2e-3)),
    Camera("FULL_OPENCV", 1280, 964, (*LENS, -0.1, 0.02, 1e-3, -2e-3, -0.002, 0.0, 0.0, 0.0)),
)


def brisk_tracks(camera: Camera = PINHOLE, count: int = 4) -> Tracks:
    tracks = orb_tracks(camera, count)
    n = len(tracks.keypoints)
    ids = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint)
    return replace(
        tracks,
        descriptor="brisk",
        descriptors=np.hstack([tracks.descriptors, tracks.descriptors[:, ::-1]]),
        sizes=np.ones(n, np.float32),
        angles=np.full(n, -1, np.float32),
        octaves=np.zeros(n, np.int32),
        landmark_of_keypoint=np.where(tracks.landmark_of_keypoint < 0, -1, ids),
        landmark_ids=np.arange(len(tracks.landmark_ids)),
    )


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("old", [False, True])
def test_what_was_written_is_read(camera: Camera, old: bool, tmp_path: Path) -> None:
    path, tracks = tmp_path / "a.map", brisk_tracks(camera)
    write_astrobee(path, tracks, old=old, scale=1.5)
    assert recognizes(path, path.read_bytes()[:4096])
    found = read(path)
    assert_same(found, tracks, 0.02)
    assert found.keyframe_names == tracks.keyframe_names
    assert np.abs(reprojection_errors(found)).max() < 0.05
    assert found.info["detector"] == {"name": "ORGBRISK", "equalization": "histogram"}
    assert len(build_map(found, pm.Encoder.load("brisk"))) > 100


def test_other_descriptors(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    write_astrobee(path, brisk_tracks(), "TEBLID512")
    assert read(path).descriptor == "teblid512"
    tracks = brisk_tracks()
    tracks.descriptors = np.repeat(tracks.descriptors, 4, axis=1)
    write_astrobee(path, tracks, "SURF")
    with pytest.raises(ValueError, match=r"SURF \(256 bytes\) descriptors, but Protomark takes"):
        read(path)


def test_other_files(tmp_path: Path) -> None:
    for data in (
        b"",
        b"\x08\x12",
        b"\1\3" + bytes(7) + b"0.2",
        b"\x86\xa7cameras",
        b"SQLite format",
    ):
        assert not recognizes(tmp_path, data)


def test_broken_maps(tmp_path: Path) -> None:
    write_astrobee(tmp_path / "a.map", brisk_tracks(CAMERAS[3], 2))
    check_broken_files(tmp_path / "a.map", read, tmp_path)
