"""kapture data sets: what we write, what kapture itself wrote, and broken ones."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from foreign_scene import assert_same, check_broken_files, foreign, orb_tracks, reprojection_errors
from protomark import sample
from protomark.geometry.camera import Camera
from protomark.tracks.file import Tracks
from protomark.tracks.importers.kapture import read, recognizes, write_kapture


def plain_tracks() -> Tracks:
    tracks = orb_tracks()
    label = np.searchsorted(tracks.landmark_ids, tracks.landmark_of_keypoint)
    return replace(
        tracks,
        octaves=np.zeros_like(tracks.octaves),
        landmark_of_keypoint=np.where(tracks.landmark_of_keypoint < 0, -1, label),
        landmark_ids=np.arange(len(tracks.landmark_ids)),
        keyframe_names=[f"left/{name}" for name in tracks.keyframe_names],
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_kapture(plain_tracks(), tmp_path / "map")
    return tmp_path / "map"


def test_what_was_written_is_read(folder: Path) -> None:
    tracks = plain_tracks()
    assert recognizes(folder, b"")
    found = read(folder)
    assert_same(found, tracks)
    assert found.keyframe_names == tracks.keyframe_names
    assert found.info["source"]["version"] == "1.1"
    assert found.info["detector"] == {"name": "ORB"}
    assert np.abs(reprojection_errors(found)).max() < 1e-3


def test_the_sample_survives(tmp_path: Path) -> None:
    toy = replace(sample.load(), descriptor="freak")
    write_kapture(toy, tmp_path / "toy")
    found = read(tmp_path / "toy")
    assert found.descriptor == "freak"
    assert_same(replace(found, octaves=toy.octaves), toy)


def test_keypoints_without_an_angle(tmp_path: Path) -> None:
    tracks = plain_tracks()
    tracks.angles = np.full_like(tracks.angles, -1)
    write_kapture(tracks, tmp_path / "map")
    assert_same(read(tmp_path / "map"), tracks)


def test_version_1_0_has_one_type(folder: Path) -> None:
    model = folder / "reconstruction"
    for what in ("keypoints", "descriptors"):
        (model / what / "ORB").rename(model / "one")
        (model / what).rmdir()
        (model / "one").rename(model / what)
    (model / "descriptors" / "descriptors.txt").write_text(
        "# kapture format: 1.0\nORB, uint8, 32\n"
    )
    file = model / "observations.txt"
    file.write_text(file.read_text().replace(" ORB,", ""))
    assert_same(read(folder), plain_tracks())


def test_features_in_a_tar(folder: Path) -> None:
    for what in ("keypoints", "descriptors"):
        place = folder / "reconstruction" / what / "ORB"
        with tarfile.open(place / f"{what}.tar", "w") as tar:
            tar.add(place / "left", "left")
        for file in (place / "left").iterdir():
            file.unlink()
    assert_same(read(folder), plain_tracks())


def test_cameras_on_a_rig(folder: Path) -> None:
    tracks = plain_tracks()
    (folder / "sensors" / "rigs.txt").write_text(
        "outer, rig, 1, 0, 0, 0, 0, 0, 0\nrig, camera1, 1, 0, 0, 0, 0.5, 0, 0\n"
    )
    file = folder / "sensors" / "trajectories.txt"
    file.write_text(file.read_text().replace("camera1", "outer"))
    found = read(folder)
    tracks.cam_from_world[:, 0, 3] += 0.5
    np.testing.assert_allclose(found.cam_from_world, tracks.cam_from_world, atol=1e-12)


def test_names_that_kapture_cannot_have(tmp_path: Path) -> None:
    for name in ("../a.jpg", "/a.jpg", "a,b.jpg", "a\nb.jpg"):
        tracks = replace(plain_tracks(), keyframe_names=[name, "1", "2", "3"])
        with pytest.raises(ValueError, match="no images with a name such as"):
            write_kapture(tracks, tmp_path / "map")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="not empty"):
        write_kapture(plain_tracks(), tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "problem"),
    [
        (
            "descriptors/ORB/descriptors",
            "ORB, uint8, 32",
            "SIFT, uint8, 128",
            r"SIFT \(128 uint8\)",
        ),
        (
            "descriptors/ORB/descriptors",
            "ORB, uint8, 32",
            "R2D2, float32, 128",
            r"R2D2 \(128 float32",
        ),
        ("descriptors/ORB/descriptors", ", 32", ", 31", r"ORB \(31 uint8\) descriptors, but"),
        ("keypoints/ORB/keypoints", "float32, 4", "float64, 5", r"image left/00000.jpg: .* bytes"),
        ("keypoints/ORB/keypoints", "float32", "object", "keypoints.txt: 4 numbers of type object"),
        (
            "observations",
            "left/00001.jpg, ",
            "left/00001.jpg, 9",
            r"left/00001.jpg: .* out of bounds",
        ),
        ("../sensors/records_camera", "left/00000", "../../00000", "is not below the data set"),
        ("../sensors/sensors", "PINHOLE", "PINHOLES", "sensor camera1: COLMAP has no camera model"),
        ("../sensors/trajectories", "0, camera1", "0, camera2", None),
    ],
)
def test_what_does_not_fit(
    file: str, old: str, new: str, problem: str | None, folder: Path
) -> None:
    path = folder / "reconstruction" / f"{file}.txt"
    path.write_text(path.read_text().replace(old, new))
    if problem is None:
        assert read(folder).info["source"]["dropped"] == {"keyframes without pose or camera": 1}
        return
    with pytest.raises(ValueError, match=problem):
        read(folder)


def test_broken_data_sets(folder: Path, tmp_path: Path) -> None:
    check_broken_files(folder, read, tmp_path)


@pytest.mark.parametrize("name", ["m1x", "t265/kapture", "virtual_gallery/kapture/training"])
def test_data_sets_of_kapture(name: str) -> None:
    path = foreign(f"kapture/{name}")
    assert recognizes(path, b"")
    with pytest.raises(ValueError, match="has no descriptors, but Protomark takes binary ones"):
        read(path)


def test_camera_models_of_colmap(tmp_path: Path) -> None:
    camera = Camera("OPENCV_FISHEYE", 1280, 964, (620.0, 618.0, 640.5, 482.5, 0.01, -0.002, 0, 0))
    tracks = replace(plain_tracks(), cameras={1: camera})
    write_kapture(tracks, tmp_path / "map")
    assert_same(read(tmp_path / "map"), tracks)
