"""Maps of COLMAP's SIFT: from its database, by both extractors, and localization in them."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import protomark as pm
from conftest import DATA, protomark
from protomark.features.distances import distances, nearest
from protomark.features.extractor import Extractor
from protomark.features.images import read_gray
from protomark.features.sift import is_rooted, root_sift
from protomark.geometry.colmap import pycolmap, read_model
from protomark.geometry.pose import pose_error
from protomark.geometry.similarity import fit_similarity
from protomark.maps.origin import map_detector
from protomark.tracks.database import read_features, stored_descriptor, tracks_from_database
from protomark.tracks.file import Tracks
from sift_scene import write_sift_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sift_scene(tmp_path_factory.mktemp("sift") / "plane")


@pytest.fixture(scope="module")
def built(scene: Path) -> Path:
    sources = (scene / "database.db", scene / "points")
    done = protomark("build", *sources, "-o", scene / "scene.pmk")
    assert done.returncode == 0, done.stderr
    return scene / "scene.pmk"


def changed(scene: Path, path: Path, change: Any) -> Path:
    """A database whose descriptors `change` makes others, by image id."""
    shutil.copy(scene / "database.db", path)
    connection = sqlite3.connect(path)
    for number, rows, data in list(
        connection.execute("SELECT image_id, rows, data FROM descriptors")
    ):
        new = change(number, np.frombuffer(data, np.uint8).reshape(rows, 128).copy())
        connection.execute(
            "UPDATE descriptors SET data = ? WHERE image_id = ?", (new.tobytes(), number)
        )
    connection.commit()
    connection.close()
    return path


def without_root(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """SIFT of length 512 whose roots are these rows."""
    numbers = rows.astype(np.float64) ** 2
    return np.rint(512 * numbers / np.linalg.norm(numbers, axis=1, keepdims=True)).astype(np.uint8)


def test_a_map_of_a_database(scene: Path, built: Path) -> None:
    assert stored_descriptor(scene / "database.db") == "sift"
    found = tracks_from_database(scene / "database.db", scene / "points", "sift")
    reconstruction = pycolmap.Reconstruction(scene / "points")
    assert len(found.landmark_ids) == len(reconstruction.points3D)
    features = read_features(scene / "database.db", "sift")
    point = reconstruction.points3D[sorted(reconstruction.points3D)[7]]
    rows = [
        features[reconstruction.images[e.image_id].name].descriptors[e.point2D_idx]
        for e in point.track.elements
    ]
    assert {*map(bytes, found.descriptors[found.landmark_of_keypoint == 7])} == {*map(bytes, rows)}
    made = pm.open(built)
    assert len(made) == len(found.landmark_ids)
    assert np.allclose(made.positions(np.array([7])), [point.xyz])
    most = max(len(one) for one in features.values())
    assert map_detector(made) == {"name": "COLMAP", "max_keypoints": most}
    assert len(pm.open(built.with_suffix(".sealed.pmk"))) == len(made)


def test_localization_in_it(scene: Path, built: Path, tmp_path: Path) -> None:
    folder = tmp_path / "found"
    words = ("localize", built.with_suffix(".sealed.pmk"), scene / "images", "-o", folder)
    done = protomark(*words, "--poses", scene / "sparse", "--threads", "1")
    assert done.returncode == 0, done.stderr
    true, found = read_model(scene / "sparse"), read_model(folder)
    assert found.names == true.names
    for one, other in zip(found.cam_from_world, true.cam_from_world, strict=True):
        distance, degrees = pose_error(one, other)
        assert distance < 0.01
        assert degrees < 0.2


def test_a_model_of_some_of_the_images(scene: Path, tmp_path: Path) -> None:
    reconstruction = pycolmap.Reconstruction(scene / "points")
    first = next(i for i in reconstruction.images.values() if i.name == "img1.png")
    reconstruction.deregister_frame(first.frame_id)
    (tmp_path / "part").mkdir()
    reconstruction.write(str(tmp_path / "part"))
    found = tracks_from_database(scene / "database.db", tmp_path / "part", "sift")
    assert found.keyframe_names == [f"img{i}.png" for i in range(2, 7)]
    assert len(found.landmark_ids)


def test_sift_without_root(scene: Path, tmp_path: Path) -> None:
    """A database may hold SIFT as Lowe normalised it, as its numbers tell."""
    path = changed(scene, tmp_path / "lowe.db", lambda _, rows: without_root(rows))
    model = scene / "points"
    rooted = tracks_from_database(scene / "database.db", model, "sift")
    found = tracks_from_database(path, model, "sift")
    off = distances(found.descriptors, rooted.descriptors, "uint8")
    assert float(np.median(off)) < 40  # small numbers lose most of their digits
    assert "root" in found.info["source"]["note"]
    assert "note" not in rooted.info["source"]


def test_keypoints_without_a_descriptor(scene: Path, tmp_path: Path) -> None:
    def clear(number: int, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        rows[:5] = 0
        return rows

    path = changed(scene, tmp_path / "zeros.db", clear)
    found = tracks_from_database(path, scene / "points", "sift")
    found.check()
    whole = tracks_from_database(scene / "database.db", scene / "points", "sift")
    assert len(found.keypoints) == len(whole.keypoints) - 5 * 6
    assert found.info["source"]["dropped"] == {"keypoints whose descriptor is zero": 30}
    done = protomark(
        *("build", path, scene / "points", "-o", tmp_path / "a.pmk", "--no-seal"),
    )
    assert done.returncode == 0, done.stderr
    assert "30 keypoints" in " ".join(done.stdout.split())


def test_databases_that_are_no_sift(scene: Path, tmp_path: Path) -> None:
    path = changed(scene, tmp_path / "half.db", lambda _, rows: rows // 2)
    with pytest.raises(ValueError, match=r"half.db has .* length 2\d\d, where SIFT has 512"):
        tracks_from_database(path, scene / "points", "sift")


def test_keypoints_of_another_model(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "moved.db"
    shutil.copy(scene / "database.db", path)
    connection = sqlite3.connect(path)
    connection.execute("UPDATE images SET name = name || '.x'")
    for old, new in (("img2.png", "img1.png"), ("img1.png", "img2.png")):
        connection.execute("UPDATE images SET name = ? WHERE name = ?", (new, f"{old}.x"))
    connection.execute("UPDATE images SET name = replace(name, '.x', '')")
    number = "(SELECT image_id FROM images WHERE name = 'img1.png')"
    connection.commit()
    with pytest.raises(ValueError, match=r"img\d.png.*(in the model|pixels from).*of this"):
        tracks_from_database(path, scene / "points", "sift")
    shutil.copy(scene / "database.db", path)
    connection.close()
    connection = sqlite3.connect(path)
    (data,) = connection.execute(f"SELECT data FROM keypoints WHERE image_id = {number}").fetchone()
    points = np.frombuffer(data, "<f4") * np.float32(1.1)
    connection.execute(
        f"UPDATE keypoints SET data = ? WHERE image_id = {number}", (points.tobytes(),)
    )
    connection.commit()
    connection.close()
    with pytest.raises(ValueError, match=r"img1.png: [\d,]+ of .*up to \d\d\.\d pixels.*undistort"):
        tracks_from_database(path, scene / "points", "sift")


def test_both_extractors_see_the_same(scene: Path) -> None:
    image = read_gray(scene / "images" / "img3.png")
    opencv = Extractor("sift", 2000)(image)
    colmap = Extractor("sift", 600, detector={"name": "COLMAP"})(image)
    stored = read_features(scene / "database.db", "sift")["img3.png"]
    for features in (opencv, colmap, stored):
        assert is_rooted(features.descriptors)[0]
        assert features.descriptors.any(1).all()
    gap = np.linalg.norm(colmap.keypoints[:, None] - stored.keypoints, axis=2)
    same = (gap < 0.1) & (np.abs(colmap.angles[:, None] - stored.angles) < 1)
    assert same.any(1).mean() > 0.9
    gap = np.linalg.norm(opencv.keypoints[:, None] - colmap.keypoints, axis=2)
    turn = np.abs((opencv.angles[:, None] - colmap.angles + 180) % 360 - 180)
    one, other = np.nonzero((gap < 0.5) & (turn < 5))
    assert len(one) > 100
    sizes = np.log2(opencv.sizes[one] / colmap.sizes[other])
    assert abs(float(np.median(sizes))) < 0.05
    off = distances(opencv.descriptors[one], colmap.descriptors[other], "uint8")
    assert float(np.median(off)) < 80


def test_upright_keypoints(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "upright.db"
    shutil.copy(scene / "database.db", path)
    connection = sqlite3.connect(path)
    for number, rows, cols, data in list(
        connection.execute("SELECT image_id, rows, cols, data FROM keypoints")
    ):
        points = np.frombuffer(data, "<f4").reshape(rows, cols)[:, :4].copy()
        points[:, 2:] = 3, 0
        connection.execute(
            "UPDATE keypoints SET cols = 4, data = ? WHERE image_id = ?", (points.tobytes(), number)
        )
    connection.commit()
    connection.close()
    found = tracks_from_database(path, scene / "points", "sift")
    assert found.info["detector"]["upright"] is True
    features = Extractor("sift", 500, detector=found.info["detector"])(
        read_gray(scene / "images" / "img1.png")
    )
    assert not features.angles.any()


@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(1, 40), st.integers(1, 255))
def test_distances_are_exact(seed: int, rows: int, queries: int, top: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = (rng.integers(0, top + 1, (n, 128), np.uint8) for n in (queries, rows))
    squares = ((one[:, None].astype(np.int64) - other) ** 2).sum(2)
    index, off = nearest(one, other, 2, "uint8")
    order = np.argsort(squares, axis=1, kind="stable")[:, :2]
    assert np.array_equal(index, order)
    expected = np.sqrt(np.take_along_axis(squares, order, 1).astype(np.float32))
    assert np.array_equal(off, expected)
    alone = distances(one[:1], other[:1], "uint8")
    assert np.array_equal(alone, np.sqrt(squares[:1, 0], dtype=np.float32))


def test_root_sift() -> None:
    rng = np.random.default_rng(0)
    rows = rng.gamma(0.5, 20, (50, 128))
    found = root_sift(rows)
    assert np.array_equal(root_sift(7 * rows), found)
    assert np.allclose(np.linalg.norm(found.astype(float), axis=1), 512, atol=3)
    assert not root_sift(np.zeros((1, 128))).any()
    assert root_sift(np.eye(128)[:1]).max() == 255


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the sequences in ../shared/data")
@pytest.mark.parametrize("sequence", ["castle", "kitti07", "hololens"])
def test_real_images_tell_the_norm(sequence: str) -> None:
    path = sorted((DATA / sequence / "images").iterdir())[0]
    rooted = Extractor("sift", 1000)(read_gray(path)).descriptors
    assert is_rooted(rooted) == (True, True)
    assert is_rooted(without_root(rooted)) == (False, True)


def test_tracks_of_images(scene: Path, tmp_path: Path) -> None:
    done = protomark("tracks", scene, "-d", "sift", "-o", tmp_path, "--max-keypoints", "400")
    assert done.returncode == 0, done.stderr
    found = Tracks.load(tmp_path / "plane.sift.safetensors")
    assert (found.descriptor, found.input) == ("sift", "uint8")
    assert len(found.landmark_ids) > 100
    # The scene is the plane z = 0, two units away.
    assert float(np.median(np.abs(found.landmark_positions[:, 2]))) < 0.005


def test_mapping_by_sift(scene: Path, tmp_path: Path) -> None:
    done = protomark(
        *("map", scene / "images", "-o", tmp_path / "map", "-d", "sift", "--max-keypoints", "600"),
        *("--camera", "PINHOLE:300,300,160,120"),
    )
    assert done.returncode == 0, done.stderr + done.stdout
    mapped, true = read_model(tmp_path / "map" / "sparse"), read_model(scene / "sparse")
    assert mapped.names == true.names
    moved = fit_similarity(mapped.centers, true.centers)(mapped.centers)
    assert np.abs(moved - true.centers).max() < 0.02
