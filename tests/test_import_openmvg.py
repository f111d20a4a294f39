"""Data sets of OpenMVG: written ones, an sfm_data of the program itself, and broken ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import protomark as pm
from foreign_scene import assert_same, check_broken_files, foreign, orb_tracks, reprojection_errors
from openmvg_writer import write_binary, write_features, write_json
from protomark.geometry.camera import Camera
from protomark.geometry.pose import transform
from protomark.maps.build import build_map
from protomark.tracks.file import Tracks
from protomark.tracks.importers.openmvg import read, recognizes
from protomark.tracks.importers.openmvg_scene import read_scene

SIZE, PINHOLE = (1280, 964), (900.0, 900.0, 641.0, 480.0)
CAMERAS = {
    "pinhole": Camera("PINHOLE", *SIZE, PINHOLE),
    "k1": Camera("OPENCV", *SIZE, (*PINHOLE, -0.05, 0.0, 0.0, 0.0)),
    "k3": Camera("FULL_OPENCV", *SIZE, (*PINHOLE, -0.05, 0.01, 0, 0, -0.01, 0, 0, 0)),
    "brown": Camera("FULL_OPENCV", *SIZE, (*PINHOLE, -0.05, 0.01, 1e-3, 2e-3, -0.01, 0, 0, 0)),
    "fisheye": Camera("OPENCV_FISHEYE", *SIZE, (*PINHOLE, -0.05, 0.01, 1e-3, -1e-3)),
}


def akaze_tracks(camera: Camera = CAMERAS["pinhole"], count: int = 4) -> Tracks:
    tracks = orb_tracks(camera, count)
    data = np.hstack([tracks.descriptors, tracks.descriptors[:, ::-1]])[:, :61]
    octaves = np.zeros_like(tracks.octaves)
    return replace(tracks, descriptor="akaze", descriptors=data.copy(), octaves=octaves)


def written(folder: Path, tracks: Tracks, kind: str) -> Path:
    """An sfm_data of a reconstruction, that of its images alone, and features."""
    (folder / "reconstruction").mkdir(parents=True)
    write_features(folder / "matches", tracks)
    empty = replace(tracks, landmark_ids=tracks.landmark_ids[:0])
    if kind == "json":
        path = folder / "reconstruction" / "sfm_data.json"
        write_json(path, tracks)
        write_json(
            folder / "matches" / "sfm_data.json",
            replace(empty, landmark_positions=np.zeros((0, 3))),
        )
    else:
        path = folder / "reconstruction" / "sfm_data.bin"
        write_binary(path, tracks, *kind.split(" ", 1))
    return path


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("kind", ["json", "0.2", "0.3", "0.3 view_priors", "0.3 view_priors used"])
def test_what_was_written_is_read(kind: str, camera: str, tmp_path: Path) -> None:
    tracks = akaze_tracks(CAMERAS[camera])
    path = written(tmp_path, tracks, kind)
    assert recognizes(path, path.read_bytes()[:4096])
    assert recognizes(tmp_path, b"")
    for source in (path, tmp_path):
        found = read(source)
        assert_same(found, tracks)
        assert found.keyframe_names == tracks.keyframe_names
        assert np.abs(reprojection_errors(found)).max() < 2e-3
        assert found.info["source"]["version"] == ("0.3" if kind == "json" else kind[:3])
    assert len(build_map(found, pm.Encoder.load("akaze"))) > 100


@pytest.mark.parametrize("describer", [None, "SIFT_Image_describer"])
def test_other_descriptors(describer: str | None, tmp_path: Path) -> None:
    path = written(tmp_path, akaze_tracks(), "0.2")
    if describer:
        text = f'{{"regions_type": {{"polymorphic_id": 1, "polymorphic_name": "{describer}"}}}}'
        (tmp_path / "matches" / "image_describer.json").write_text(text)
    else:
        write_features(tmp_path / "matches", akaze_tracks(), 128)
    with pytest.raises(
        ValueError, match=f"has {describer or '128-byte'} descriptors, but Protomark"
    ):
        read(path)


def test_features_that_are_missing(tmp_path: Path) -> None:
    path = written(tmp_path, akaze_tracks(), "0.2")
    (tmp_path / "matches" / "00001.desc").unlink()
    assert read(path).info["source"]["dropped"] == {"keyframes without features": 1}
    for file in (tmp_path / "matches").glob("*.desc"):
        file.unlink()
    with pytest.raises(ValueError, match=r"the features of its 4 images \(.feat and .desc\) are"):
        read(path)


def test_an_image_list_has_no_landmarks(tmp_path: Path) -> None:
    written(tmp_path, akaze_tracks(), "json")
    with pytest.raises(ValueError, match="without landmarks: give that of the reconstruction"):
        read(tmp_path / "matches")


@pytest.mark.parametrize("kind", ["json", "0.2", "0.3 view_priors"])
def test_broken_data_sets(kind: str, tmp_path: Path) -> None:
    written(tmp_path / "map", akaze_tracks(count=2), kind)
    check_broken_files(tmp_path / "map", read, tmp_path, 100)


def test_an_sfm_data_of_the_program() -> None:
    path = foreign("openmvg/pineapple_sfm_data.bin")
    assert recognizes(path, path.read_bytes()[:4096])
    scene = read_scene(path)
    counts = (len(scene.views), len(scene.landmark_ids), len(scene.landmarks))
    assert counts == (17, 9647, 51958)
    positions = dict(zip(scene.landmark_ids, np.array(scene.positions).reshape(-1, 3), strict=True))
    points = np.array([positions[i] for i in scene.landmarks])
    pixels, views = np.array(scene.pixels).reshape(-1, 2) + 0.5, np.array(scene.view_ids)
    errors = []
    for view, (_, camera, pose) in scene.views.items():
        seen = scene.cameras[camera].project(transform(scene.poses[pose], points[views == view]))
        errors.append(seen - pixels[views == view])
    assert np.abs(np.median(np.concatenate(errors), 0)).max() < 0.01
    assert np.median(np.linalg.norm(np.concatenate(errors), axis=1)) < 0.6
    with pytest.raises(ValueError, match="neither beside it nor in a folder"):
        read(path)
